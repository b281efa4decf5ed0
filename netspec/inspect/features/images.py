"""Computing a blob of a net for image files. docs/features.md describes the file format."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from netspec import log
from netspec.data.blobs import Shape
from netspec.data.datum import decode_pixels, planar
from netspec.data.resize import resized
from netspec.errors import SpecError, Where
from netspec.export.engines.cache import key_of
from netspec.export.engines.choice import Choice
from netspec.export.engines.model import Model, Unable, warn_unable
from netspec.export.formats.inputs import is_input, prune, shapes_of_input
from netspec.files.image_list import ImageList
from netspec.files.kinds import unreadable
from netspec.files.opencv import cv2
from netspec.graph.filter import filter_net, with_state
from netspec.graph.options import TORCH, BuildOptions
from netspec.graph.speed import speed
from netspec.inspect.features.scaling import Steps, middle, scaling_of
from netspec.proto.binary import read_net_binary
from netspec.proto.schema import TEST, NetParameter
from netspec.proto.source_map import SourceMap
from netspec.proto.text import parse_net, write_text

if TYPE_CHECKING:
    from netspec.inspect.features.records import Progress
    from netspec.net.net import Net

BATCH = 16  # images per forward pass


@dataclass(frozen=True)
class ImageInput:
    """The options for converting images to the input of a net.

    ``shape`` (N, C, H, W) is that of the input ``blob``. None: it is taken from the net's Input layer, or from the
    first record of its data layer. ``zooms`` are the views of each image. ``steps``, if given, replace the
    transform_param of the data layer.
    """

    blob: str = "data"
    shape: Shape | None = None
    zooms: Sequence[float] = (1.0,)
    steps: Steps | None = None


class ImageNet:
    """The part of a net that computes ``blob`` from images, including preprocessing.

    The net is the prototxt ``model`` in phase TEST. ``weights`` are files; a later one overrides an earlier one, and
    at least one layer must get weights. ``choice`` is the engine that runs the net. If it is not torch, and the cache
    has the model, torch is not imported. Raises SpecError for errors in the files. Warns if the weights were trained
    with different preprocessing.
    """

    def __init__(
        self,
        model: str | Path,
        weights: Sequence[str | Path],
        blob: str,
        images: ImageInput,
        choice: Choice | None = None,
        options: BuildOptions | None = None,
    ) -> None:
        options = replace(options or BuildOptions(speed=speed()), seed=0)
        read, source = parse_net(model)
        net, source = filter_net(with_state(read, TEST), source)
        input_blob = images.blob
        before, before_source = prune(net, source, [input_blob], {})
        shape = images.shape or _shape_of(input_blob, before, before_source, options)
        if len(shape) != 4 or shape[1] not in (1, 3):
            message = f'input blob "{input_blob}" has shape {tuple(shape)}, expected N x 1 or 3 x H x W for images'
            raise SpecError(message, Where(source.file))
        self.blob, self.input, self.file = blob, input_blob, source.file
        self.shape: Shape = tuple(shape[1:])
        self.zooms = tuple(images.zooms)
        transforming = [layer for layer in before.layer if layer.HasField("transform_param")]
        steps = images.steps or Steps()
        self.scaling = scaling_of(steps, transforming[0] if transforming else None, self.shape, source.file)
        after, after_source = prune(net, source, [blob], {input_blob: shape})

        def build() -> Net:
            built = _build(after, after_source, weights, options)
            for path in weights:
                if not transforming and not steps:
                    readers = [layer.name for layer in after.layer if input_blob in layer.bottom]
                    _warn_of_other_pixels(path, model, readers)
            return built

        self._build, self._net, self._model = build, None, None
        self._read, self._weights = read, weights
        self._choice = choice or Choice()
        made_of = {"blob": blob, "input": input_blob, "shape": shape, "strict": options.strict, "scaled": bool(steps)}
        self._open(partial(key_of, [model, *weights], made_of), options.device)

    def _open(self, key: Callable[[], str], device: str) -> None:
        """Open the model of the chosen engine, or let torch run the net."""
        if self._choice.engine == TORCH or device != "cpu":
            self._use_torch("" if self._choice.engine == TORCH else f"it runs on the CPU, but this net is on {device}")
            return
        try:
            self._model = Model(self._choice, key(), self._export)
        except Unable as fault:
            self._use_torch(str(fault))

    def _use_torch(self, reason: str) -> None:
        """Let torch run the net; ``reason`` is why the chosen engine does not."""
        warn_unable(self._choice, reason)
        self._model, self._net = None, self._build()
        self._net.keep = [self.blob]

    def _export(self, path: Path) -> None:
        from netspec.export.engines.net import write_model

        write_model(self._build(), path)

    @property
    def engine(self) -> str:
        """The engine that runs the net: the chosen one, or torch if that one cannot."""
        return TORCH if self._model is None else self._choice.engine

    @cached_property
    def fingerprint(self) -> str:
        """A hash of everything that determines the blob except the engine: net, weights and preprocessing."""
        s = self.scaling
        mean = [0.0] if s.mean is None else s.mean.tolist()
        done = f"{self.input} {self.blob} {self.shape} {self.zooms} {mean} {s.scale} {s.raw_scale} {s.swap}"
        digest = hashlib.sha256(self._read.SerializeToString(deterministic=True) + done.encode())
        for path in self._weights:
            digest.update(Path(path).read_bytes())
        return digest.hexdigest()[:16]

    def __call__(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Return the blob (N, V D) float32, views in order, of images (H, W, 3) or (H, W), uint8, BGR, of any size."""
        return self.values(self.inputs(images)).reshape(len(images), -1)

    def inputs(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Return the input blob (N V, C, H, W) float32 for N images: the V views of each in order."""
        views = [fitted(middle(image, zoom), self.shape) for image in images for zoom in self.zooms]
        return self.scaling(np.stack(views))

    def values(self, data: np.ndarray) -> np.ndarray:
        """Return the blob (N V, ...) float32, in its own shape, for a result of :meth:`inputs`."""
        if self._model is not None:
            try:
                return self._model.run({self.input: data})[self.blob]
            except Unable as fault:
                self._use_torch(str(fault))
        import torch

        assert self._net is not None, "torch runs this net"
        with torch.no_grad():
            self._net(**{self.input: torch.from_numpy(data)})
        return self._net.blobs[self.blob].cpu().numpy()


def extract_images(describe: ImageNet, images: ImageList, progress: Progress = iter) -> dict[str, np.ndarray]:
    """Return the arrays of a features.npz: features, names, seconds_per_image; also stamps and zooms, if any.

    The seconds include everything from file to feature: reading, resizing, the net.
    """
    parts = []
    begin = time.perf_counter()
    for start in progress(range(0, len(images.paths), BATCH)):
        parts.append(describe([read_pixels(path, describe.shape[0]) for path in images.paths[start : start + BATCH]]))
    seconds = (time.perf_counter() - begin) / len(images.paths)
    arrays = {
        "features": np.concatenate(parts),
        "names": np.array(images.names),
        "seconds_per_image": np.array(seconds),
    }
    if images.stamps is not None:
        arrays["stamps"] = images.stamps
    if describe.zooms != (1.0,):
        arrays["zooms"] = np.array(describe.zooms)
    return arrays


def _shape_of(blob: str, net: NetParameter, source: SourceMap, options: BuildOptions) -> Shape:
    """Return the shape of a blob of a net. Opens data, but allocates no blobs."""
    if len(net.layer) == 1 and is_input(net.layer[0]) and (known := shapes_of_input(net.layer[0]).get(blob)):
        return known  # does not need torch
    from netspec.net.build import build_filtered

    built = build_filtered(net, source, replace(options, device="meta"))
    built.close()
    return built.shapes[blob]


def _build(net: NetParameter, source: SourceMap, weights: Sequence[str | Path], options: BuildOptions) -> Net:
    from netspec.net.build import build_filtered
    from netspec.net.weights import load_weights

    built = build_filtered(net, source, options)
    if weights:
        load_weights(built, weights, options.strict, need_one=True)
    return built


def _warn_of_other_pixels(weights: str | Path, model: str | Path, readers: Sequence[str]) -> None:
    """Warn if a .caffemodel contains a transform_param, but the net that gets its weights does not scale pixels.

    ``readers`` are the layers of that net that read the input. If the trained net lacks one of them (a Power layer in a
    deploy file, say), it is assumed to replace the transform_param. An HDF5 file contains no settings.
    """
    import h5py

    if h5py.is_hdf5(weights):
        return
    trained = read_net_binary(weights).layer
    if not set(readers) <= {layer.name for layer in trained}:
        return
    for layer in trained:
        p = layer.transform_param
        if p.scale != 1 or p.mean_value or p.mean_file:
            settings = " ".join(write_text(p).split())
            log.logger.warning(
                f"{weights} was trained with transform_param {{ {settings} }}, but {model} has no transform_param, so "
                "its pixels stay 0 to 255; use the training prototxt as the model"
            )
            return


def read_pixels(path: Path, channels: int) -> np.ndarray:
    """Return an image file as (H, W, 3) BGR for three ``channels``, else as (H, W), uint8. Raises SpecError."""
    try:
        return decode_pixels(path.read_bytes(), channels == 3)
    except OSError as fault:
        raise SpecError(unreadable(path, fault), Where(str(path))) from None
    except ValueError as fault:
        raise SpecError(str(fault), Where(str(path))) from None


def fitted(image: np.ndarray, shape: Shape) -> np.ndarray:
    """Return an image (H, W, 3) BGR or (H, W), uint8, as ``shape`` (C, H, W): resized (bilinear), in color or gray."""
    channels, height, width = shape
    if channels == 3 and image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    elif channels == 1 and image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if image.shape[:2] != (height, width):
        image = resized(image, height, width)
    return planar(image)
