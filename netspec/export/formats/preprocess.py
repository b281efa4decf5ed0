"""Preprocessing of images as part of the exported model.

Caffe: Transformer.preprocess (python/caffe/io.py), DataTransformer::Transform (src/caffe/data_transformer.cpp)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from netspec.data.mean import fitted
from netspec.data.preprocess import preprocessed
from netspec.errors import SpecError, Where

if TYPE_CHECKING:
    from netspec.export.formats.shapes import Sizes  # which imports torch


@dataclass(frozen=True)
class Preprocess:
    """The preprocessing steps of input ``blob``, in this order: crop, swap, raw_scale, mean, scale.

    ``crop``: larger images are cropped to their center. ``swap``: the channels are reversed, that is,
    RGB for a net that was trained with BGR. ``raw_scale`` multiplies, ``mean`` is subtracted, ``scale`` multiplies;
    ``mean`` is one number for each channel, or an array (C, H, W) of the input's size. ``uint8``: images are uint8.
    """

    blob: str = "data"
    mean: np.ndarray | None = None
    scale: float = 1.0
    raw_scale: float = 1.0
    swap: bool = False
    crop: bool = False
    uint8: bool = False

    @property
    def changes_images(self) -> bool:
        """Whether there is any step."""
        return self.mean is not None or (self.scale, self.raw_scale) != (1, 1) or self.swap or self.crop or self.uint8

    @property
    def description(self) -> str:
        """A description of the exported model's input, in one line."""
        steps = [
            *(["images are cropped to the net's size"] if self.crop else []),
            *(["the channels are reversed"] if self.swap else []),
            *([f"multiplied by {self.raw_scale:g}"] if self.raw_scale != 1 else []),
            *(["the mean is subtracted"] if self.mean is not None else []),
            *([f"multiplied by {self.scale:g}"] if self.scale != 1 else []),
        ]
        kind = "uint8" if self.uint8 else "float32"
        order = "RGB for a net of BGR images" if self.swap else "channels in the net's order"
        return f"{self.blob}: {kind} (N, C, H, W), {order}; inside the model: {', then '.join(steps) or 'nothing else'}"

    def mean_for(self, shape: Sizes) -> np.ndarray | None:
        """Return the mean in a shape for subtraction from an input (N, C, H, W) of this shape."""
        return None if self.mean is None else fitted(self.mean, shape[1:], "the mean", Where("--mean"))

    def check(self, shape: Sizes) -> None:
        """Raise SpecError if the steps do not fit an input of this shape."""
        if len(shape) != 4:
            raise SpecError(f"{self.blob} has shape {shape}, expected images (N, C, H, W)")
        self.mean_for(shape)
        if self.crop and None in shape[2:]:
            raise SpecError(f"--crop: the height and width of {self.blob} are dynamic, so there is no size to crop to")

    def applied(self, shape: Sizes, images: Any) -> Any:
        """Return images, a tensor, after the steps for an input of this shape."""
        images = images.float() if self.uint8 else images.clone()  # the steps change it
        for axis, size in ((2, shape[2]), (3, shape[3])) if self.crop else ():
            images = images.narrow(axis, (images.shape[axis] - size) // 2, size)
        images = images.flip(1) if self.swap else images
        mean = self.mean_for(shape)
        given = images.new_tensor(mean) if mean is not None else None
        return preprocessed(images, None, self.raw_scale, given, self.scale)
