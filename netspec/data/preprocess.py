"""What is done to the pixels of an image before a net, as one value and one function.

Caffe: Transformer.preprocess (python/caffe/io.py), DataTransformer::Transform (src/caffe/data_transformer.cpp)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from netspec.data.blobs import Shape
from netspec.data.mean import center, read_mean_option
from netspec.errors import SpecError, Where


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
        """Return the steps with a mean that broadcasts against images of ``shape`` (C, H, W); ``name`` is the mean's.

        A mean image larger than the images is cropped to its center, as in Caffe in phase TEST. Raises SpecError for a
        mean that does not fit.
        """
        if self.mean is None:
            return self
        mean, (channels, height, width) = self.mean, shape
        if mean.ndim < 2:
            if mean.size not in (1, channels):
                raise SpecError(f"{name} has {mean.size} values, expected 1 or {channels}, one for each channel", where)
            return replace(self, mean=mean.reshape(-1, 1, 1))
        mean = mean[0] if mean.ndim == 4 and len(mean) == 1 else mean
        if mean.ndim != 3 or mean.shape[0] != channels or mean.shape[1] < height or mean.shape[2] < width:
            raise SpecError(f"{name} has shape {mean.shape}, expected at least {shape} for these images", where)
        return replace(self, mean=center(mean, height, width))

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """Return the input of the net, float32, for images (..., C, H, W); the mean must fit: see :meth:`fitted`."""
        order = slice(None, None, -1) if self.swap else None
        return preprocessed(images.astype(np.float32), order, self.raw_scale, self.mean, self.scale)

    def __str__(self) -> str:
        values = np.zeros(1) if self.mean is None else self.mean.reshape(-1)
        channels = values[:1] if np.all(values == values[0]) else values
        subtracted = ", ".join(f"{value:g}" for value in channels) if len(channels) <= 3 else "a mean image"
        mean = f", minus {subtracted}" if np.any(values) else ""
        raw_scale, scale = (f", times {factor:g}" if factor != 1 else "" for factor in (self.raw_scale, self.scale))
        return f"0 to 255{raw_scale}{mean}{scale} ({self.source})"


def preprocessed(
    values: np.ndarray, order: slice | list[int] | None, raw_scale: float, mean: np.ndarray | None, scale: float
) -> np.ndarray:
    """Return float32 images (..., C, H, W) with their channels in this order (None: as they are), scaled.

    As in Caffe, an array whose channels are not reordered is itself changed.
    """
    if order is not None:
        values = values[..., order, :, :]
    if raw_scale != 1:
        values *= np.float32(raw_scale)
    if mean is not None:
        values -= mean
    if scale != 1:
        values *= np.float32(scale)
    return values
