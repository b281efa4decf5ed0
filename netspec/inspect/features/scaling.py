"""Scales the pixels of an image for a net: like Caffe's Transformer, or like the data layer's transform_param.

Caffe: Transformer.preprocess (python/caffe/io.py), DataTransformer::Transform (src/caffe/data_transformer.cpp)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netspec.data.blobs import Shape
from netspec.data.mean import center, read_mean
from netspec.errors import SpecError, Where
from netspec.export.formats.preprocess import read_mean_option
from netspec.proto.schema import LayerParameter


@dataclass(frozen=True)
class Steps:
    """The preprocessing steps given by the user, in this order: swap, raw_scale, mean, scale.

    Images are as read by OpenCV: BGR, 0 to 255. ``swap`` reverses their channels, for a net that was trained with
    RGB. ``raw_scale`` multiplies. ``mean`` is subtracted: one number, or one per channel of the net, or a mean image
    (C, H, W); ``scale`` multiplies.
    """

    mean: np.ndarray | None = None
    scale: float = 1.0
    raw_scale: float = 1.0
    swap: bool = False

    def __bool__(self) -> bool:
        return self.mean is not None or (self.scale, self.raw_scale) != (1, 1) or self.swap

    @staticmethod
    def of(
        mean: str | float | Sequence[float] | np.ndarray | None,
        scale: str | float,
        raw_scale: str | float,
        swap: str | bool,
    ) -> Steps:
        """Return the steps, which can be texts as on the command line. Raises SpecError."""
        values = read_mean_option(mean) if isinstance(mean, str) else mean
        try:
            factors = float(scale), float(raw_scale)
        except ValueError as fault:
            raise SpecError(f"scale and raw_scale are numbers: {fault}") from None
        if str(swap).lower() not in ("true", "false", "1", "0"):
            raise SpecError(f'found swap "{swap}", expected true or false')
        reverses = str(swap).lower() in ("true", "1")
        return Steps(None if values is None else np.asarray(values, np.float32), *factors, reverses)


@dataclass(frozen=True)
class Scaling:
    """(raw_scale x - mean) * scale for images (N, C, H, W). With ``swap``, their channels are reversed first.

    ``mean`` broadcasts against (C, H, W). ``source`` describes its origin.
    """

    mean: np.ndarray
    scale: float
    source: str
    raw_scale: float = 1.0
    swap: bool = False

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """Return the input of the net."""
        images = images[:, ::-1] if self.swap else images
        images = images if self.raw_scale == 1 else images * np.float32(self.raw_scale)
        return (images - self.mean) * self.scale

    def __str__(self) -> str:
        values = self.mean.reshape(-1)
        channels = values[:1] if np.all(values == values[0]) else values
        subtracted = ", ".join(f"{value:g}" for value in channels) if len(channels) <= 3 else "a mean image"
        mean = f", minus {subtracted}" if np.any(values) else ""
        raw_scale, scale = (f", times {factor:g}" if factor != 1 else "" for factor in (self.raw_scale, self.scale))
        return f"0 to 255{raw_scale}{mean}{scale} ({self.source})"


def scaling_of(steps: Steps, layer: LayerParameter | None, shape: Shape, file: str) -> Scaling:
    """Return the scaling for images of ``shape`` (C, H, W), from ``steps`` if given, else a layer's transform_param.

    ``file`` is the layer's prototxt. Raises SpecError for a mean that does not fit.
    """
    if steps:
        mean = np.zeros(1) if steps.mean is None else _fitted(steps.mean, shape, "the mean", Where("--mean"))
        return Scaling(mean, steps.scale, "from the options", steps.raw_scale, steps.swap)
    if layer is None:
        return Scaling(np.zeros(1), 1.0, "no transform_param")
    param: Any = layer.transform_param
    source = f'transform_param of layer "{layer.name}"'
    if param.mean_file:
        mean = read_mean(param.mean_file, Where(file))[: shape[0]]  # for a pair, use the mean of its first image
        return Scaling(_fitted(mean, shape, param.mean_file, Where(file)), param.scale, source)
    values = np.array(param.mean_value or [0], np.float32)
    if len(values) == 2 * shape[0]:  # a pair's
        values = values[: shape[0]]
    return Scaling(_fitted(values, shape, "mean_value", Where(file)), param.scale, source)


def _fitted(mean: np.ndarray, shape: Shape, name: str, where: Where) -> np.ndarray:
    """Return a mean that broadcasts against ``shape`` (C, H, W).

    A mean image larger than the blob is cropped to its center, as in Caffe in phase TEST.
    """
    channels, height, width = shape
    if mean.ndim < 2:
        if mean.size not in (1, channels):
            raise SpecError(f"{name} has {mean.size} values, expected 1 or {channels}, one for each channel", where)
        return mean.reshape(-1, 1, 1)
    mean = mean[0] if mean.ndim == 4 and len(mean) == 1 else mean
    if mean.ndim != 3 or mean.shape[0] != channels or mean.shape[1] < height or mean.shape[2] < width:
        raise SpecError(f"{name} has shape {mean.shape}, expected at least {shape} for these images", where)
    return center(mean, height, width)


def read_zooms(zooms: str | float) -> tuple[float, ...]:
    """Return the zooms in a text such as ``"1,0.7"``: the share of the image's height and width in each view.

    Raises SpecError unless each is above 0 and at most 1.
    """
    try:
        found = tuple(float(text) for text in str(zooms).split(","))
    except ValueError:
        raise SpecError(f'found zooms "{zooms}", expected numbers separated by commas, e.g. "1,0.7"') from None
    for zoom in found:
        if not 0 < zoom <= 1:
            raise SpecError(f"found zoom {zoom:g}, expected a number above 0 and at most 1 (the whole image)")
    return found


def middle(image: np.ndarray, zoom: float) -> np.ndarray:
    """Return the center of an image, with ``zoom`` times its height and width; 1 is the whole image."""
    height, width = image.shape[:2]
    top, left = round(height * (1 - zoom) / 2), round(width * (1 - zoom) / 2)
    return image[top : max(height - top, top + 1), left : max(width - left, left + 1)]
