"""FaceBoxes: PriorBox with a dense grid of boxes of each fixed size around the center of a pixel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from typing_extensions import override

from netspec.dialects.boxes import Array
from netspec.dialects.ssd import priors
from netspec.layers.contract.base import Shape
from netspec.proto.schema import LayerParameter, given_fields, value


def is_fixed(layer: LayerParameter) -> bool:
    """Return whether a PriorBox has boxes of fixed sizes."""
    return "fixed_size" in given_fields(value(layer, "prior_box_param"))


class PriorBox(priors.PriorBox):
    """Compute boxes of fixed sizes; each has density x density centers, spread over its size around the pixel's center.

    For each fixed_size s: with fixed_ratio, boxes of s sqrt(r) by s / sqrt(r) for each ratio r, else squares and then
    those of the aspect_ratio other than 1. Centers are whole pixels of s / density apart. Boxes end at the image's
    border. Fields, bottoms and top are otherwise those of SSD's.

    bottom[0]  the map (N, C, H, W)
    bottom[1]  the image (N, C', H', W'); not needed if img_size, or img_h and img_w, are given
    top[0]     (1, 2, 4 H W K), K boxes per pixel: [0, 0] relative (xmin, ymin, xmax, ymax), [0, 1] variances
    Fork: sfzhang15/FaceBoxes, src/caffe/layers/prior_box_layer.cpp
    """

    @override
    def sizes_of(self, param: Any) -> Array:
        """Return the widths and heights of the boxes of one pixel (K, 2), and keep where they are."""
        if len(param.density) != len(param.fixed_size) or min(param.density) < 1 or min(param.fixed_size) < 1:
            found = f"found {len(param.fixed_size)} fixed_size and density {list(param.density)}"
            raise self.error(f"{found}, expected as many of each, at least 1", "prior_box_param", "fixed_size")
        if any(ratio <= 0 for ratio in param.fixed_ratio):
            raise self.error("fixed_ratio must be above 0", "prior_box_param", "fixed_ratio")
        sizes, shifts = [], []
        for size, density in zip(param.fixed_size, param.density, strict=True):
            apart = int(size / density)
            along = [apart / 2 + apart * i - int(size) // 2 for i in range(density)]
            for ratio in param.fixed_ratio or self.ratios_of(param):
                sizes += [(size * math.sqrt(ratio), size / math.sqrt(ratio))] * density**2
                shifts += [(x, y) for y in along for x in along]
        self.shifts = np.array(shifts)
        return np.array(sizes, np.float32)

    @override
    def placed(self, center: Array, half: Array, step: float) -> tuple[Array, Array]:
        return center + self.shifts, half

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shapes = super().reshape(bottom_shapes)
        boxes = self.boxes[0, 0].reshape(-1, 4)
        boxes[:, :2], boxes[:, 2:] = boxes[:, :2].clip(min=0), boxes[:, 2:].clip(max=1)
        return shapes
