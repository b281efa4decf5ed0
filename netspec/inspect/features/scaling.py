"""What is done to the pixels of an image before a net, as a value; and the views of an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from netspec.data.blobs import Shape
from netspec.data.mean import fitted, read_mean, read_mean_option
from netspec.data.preprocess import preprocessed
from netspec.errors import SpecError, Where
from netspec.proto.schema import LayerParameter


@dataclass(frozen=True)
class Steps:
    """The steps, in this order: swap, raw_scale, mean, scale.

    ``swap`` reverses the channels: images are as read by OpenCV, BGR, and a net may have been trained with RGB.
    ``raw_scale`` multiplies. ``mean`` is subtracted: one number, or one per channel of the net, or a mean image
    (C, H, W). ``scale`` multiplies. ``source`` describes their origin.
    """

    mean: np.ndarray | None = None
    scale: float = 1.0
    raw_scale: float = 1.0
    swap: bool = False
    source: str = ""

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
        return Steps(None if values is None else np.asarray(values, np.float32), *factors, reverses, "from the options")

    def fitted(self, shape: Shape, name: str, where: Where) -> Steps:
        """Return the steps with a mean that broadcasts against images of ``shape`` (C, H, W): see data/mean.py."""
        return self if self.mean is None else replace(self, mean=fitted(self.mean, shape, name, where))

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """Return the input of the net, float32, for images (..., C, H, W); the mean must fit: see :meth:`fitted`."""
        order = range(images.shape[-3])[::-1] if self.swap else None
        return preprocessed(images.astype(np.float32), order, self.raw_scale, self.mean, self.scale)

    def __str__(self) -> str:
        values = np.zeros(1) if self.mean is None else self.mean.reshape(-1)
        channels = values[:1] if np.all(values == values[0]) else values
        subtracted = ", ".join(f"{value:g}" for value in channels) if len(channels) <= 3 else "a mean image"
        mean = f", minus {subtracted}" if np.any(values) else ""
        raw_scale, scale = (f", times {factor:g}" if factor != 1 else "" for factor in (self.raw_scale, self.scale))
        return f"0 to 255{raw_scale}{mean}{scale} ({self.source})"


def scaling_of(steps: Steps, layer: LayerParameter | None, shape: Shape, file: str) -> Steps:
    """Return the steps for images of ``shape`` (C, H, W): ``steps`` if there are any, else a layer's transform_param.

    ``file`` is the layer's prototxt. Raises SpecError for a mean that does not fit.
    """
    if steps:
        return replace(steps, source="from the options").fitted(shape, "the mean", Where("--mean"))
    if layer is None:
        return Steps(source="no transform_param")
    param: Any = layer.transform_param
    source = f'transform_param of layer "{layer.name}"'
    if param.mean_file:
        mean = read_mean(param.mean_file, Where(file))[: shape[0]]  # for a pair, use the mean of its first image
        return Steps(mean, param.scale, source=source).fitted(shape, param.mean_file, Where(file))
    values = np.array(param.mean_value or [0], np.float32)
    if len(values) == 2 * shape[0]:  # a pair's
        values = values[: shape[0]]
    return Steps(values, param.scale, source=source).fitted(shape, "mean_value", Where(file))


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
