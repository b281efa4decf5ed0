"""The transformation of an image between the database and the net: crop, mirror, mean, scale.

Caffe: src/caffe/data_transformer.cpp
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from netspec import log
from netspec.data.blobs import Shape
from netspec.data.datum import datum_to_array, shape_text
from netspec.data.mean import read_mean
from netspec.data.random_words import WORDS, words_at
from netspec.errors import SpecError, Where
from netspec.proto.schema import TRAIN


def contradictions(param: Any, at: Callable[..., Where]) -> Iterator[SpecError]:
    """Yield a SpecError for each pair of contradictory settings in a transform_param."""
    if param.force_color and param.force_gray:
        yield SpecError("force_color and force_gray cannot both be set", at("transform_param", "force_gray"))
    yield from mean_contradictions(param, at)


def mean_contradictions(param: Any, at: Callable[..., Where]) -> Iterator[SpecError]:
    """Yield a SpecError if a transform_param has two kinds of mean."""
    if param.HasField("mean_file") and param.mean_value:
        yield SpecError("mean_file and mean_value cannot both be set", at("transform_param", "mean_value"))


class Transformer:
    """Applies a ``transform_param``: (x - mean) * scale of a window of each image, mirrored or not.

    The window is random in TRAIN and central in TEST. The random numbers of record k, for mirror, h_off and w_off in
    Caffe's order, depend only on ``seed``, ``stream`` and k. ``at(*path)`` is the position of a field of the layer.
    Raises SpecError for contradictory settings and for a mean file that cannot be read.
    """

    def __init__(self, param: Any, phase: int, at: Callable[..., Where], seed: int = 0, stream: str = "") -> None:
        self._at = at
        self._random_crop = phase == TRAIN and param.crop_size > 0
        self._seed, self._stream = seed, stream
        self.crop_size: int = param.crop_size
        self.mirror: bool = param.mirror
        self.scale = np.float32(param.scale)
        for fault in contradictions(param, at):
            raise fault
        self.color: bool | None = True if param.force_color else False if param.force_gray else None
        self.mean_values = np.array(param.mean_value, np.float32)
        self._mean_file = param.mean_file
        self._mean = read_mean(param.mean_file, at("transform_param", "mean_file")) if param.mean_file else None
        self._warned: set[str] = set()

    def decode(self, datum: Any) -> np.ndarray:
        """Return a Datum's image (C, H, W), in color or gray if the transform forces it; raises ValueError."""
        if self.color is not None and not datum.encoded:
            self._warn_once("data_transformer.cpp:152", "force_color and force_gray only for encoded datum")
        return datum_to_array(datum, self.color, self._warn_long)

    def _warn_long(self, fault: str) -> None:
        self._warn_once("data_transformer.cpp:63", f"{self._at()}: a record {fault}; only the first values are used")

    def _warn_once(self, site: str, message: str) -> None:
        if site not in self._warned:
            self._warned.add(site)
            log.warning(site, message)

    def output_shape(self, shape: Shape) -> Shape:
        """Return the shape of a transformed image of ``shape`` (C, H, W).

        Raises SpecError if the image does not fit the crop or the mean.
        """
        channels, height, width = shape
        if self.crop_size > min(height, width):
            raise self._error(f"crop_size {self.crop_size} is larger than the image, {shape_text(shape)}", "crop_size")
        if self._mean is not None and self._mean.shape != shape:
            mean = f'the mean of "{self._mean_file}" has shape {shape_text(self._mean.shape)}'
            raise self._error(f"{mean}, the image before cropping {shape_text(shape)}; they must be equal", "mean_file")
        if len(self.mean_values) not in (0, 1, channels):
            message = f"found {len(self.mean_values)} mean_value for {channels} channels, expected 1 or {channels}"
            raise self._error(message, "mean_value")
        return (channels, self.crop_size, self.crop_size) if self.crop_size else shape

    def __call__(self, images: Sequence[np.ndarray] | np.ndarray, positions: range) -> np.ndarray:
        """Return the images, uint8 or float32 (C, H, W), as one batch: float32 (N, C, H', W').

        Images in one array (N, C, H, W) are transformed together. ``positions`` are the images' indices in the
        sequence of all records read; they determine the random numbers.
        """
        batch = np.empty((len(images), *self.output_shape(images[0].shape)), np.float32)
        drawn = self.mirror or self._random_crop
        draws = words_at(self._seed, self._stream, positions) if drawn else np.zeros((len(images), WORDS), np.uint64)
        if isinstance(images, np.ndarray):
            self._transform(images, batch, draws)
        else:
            for k, image in enumerate(images):
                self._transform(image[None], batch[k : k + 1], draws[k : k + 1])
        if self.scale != 1:
            batch *= self.scale
        return batch

    def _transform(self, images: np.ndarray, out: np.ndarray, draws: np.ndarray) -> None:
        """Write transformed images of one size, without the scale; ``draws`` (N, 4) are their random numbers."""
        mean = self.mean_values[:, None, None] if len(self.mean_values) else self._mean
        if self.crop_size:
            spare = np.array(images.shape[2:], np.uint64) - np.uint64(self.crop_size)
            corners = draws[:, 1:3] % (spare + np.uint64(1)) if self._random_crop else (spare // np.uint64(2))[None]
            images = _windows(images, corners, self.crop_size)
            if self._mean is not None:
                mean = _windows(self._mean[None], corners, self.crop_size)
        out[...] = images
        if mean is not None:
            out -= mean
        if self.mirror:
            mirrored = np.flatnonzero(draws[:, 0] % np.uint64(2))
            out[mirrored] = out[mirrored, :, :, ::-1]

    def _error(self, message: str, field: str) -> SpecError:
        return SpecError(message, self._at("transform_param", field))


def _windows(images: np.ndarray, corners: np.ndarray, size: int) -> np.ndarray:
    """Return a square window of each of N images, or N windows of one image: (N, C, size, size).

    ``corners`` (N, 2) are their upper left corners; a single one applies to all.
    """
    if len(corners) == 1:
        top, left = map(int, corners[0])
        return images[:, :, top : top + size, left : left + size]
    windows = np.lib.stride_tricks.sliding_window_view(images, (size, size), axis=(2, 3))
    each = np.arange(len(images)) if len(images) > 1 else 0
    return windows[each, :, corners[:, 0], corners[:, 1]]
