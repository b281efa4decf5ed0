"""SSD's PriorBox: boxes with several sizes around every pixel of a map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from netspec import log
from netspec.dialects.boxes import Array
from netspec.layers import Layer
from netspec.layers.contract.base import Shape
from netspec.proto.schema import value


class PriorBox(Layer):
    """Compute boxes with several sizes and aspect ratios around the center of every pixel of a map.

    For each min_size: a square of this size; with max_sizes, a square of sqrt(min_size max_size); for each aspect_ratio
    r, and 1 / r with ``flip``, min_size sqrt(r) by min_size / sqrt(r). Sizes are truncated to integers. Centers are at
    (index + offset) step; by default, the step is image / map, and the image is bottom[1]. With
    denser_prior_boxes (TextBoxes++), each box is followed by one with its center at (row + 1) step.

    bottom[0]  the map (N, C, H, W)
    bottom[1]  the image (N, C', H', W'); not needed if img_size, or img_h and img_w, are given
    top[0]     (1, 2, 4 H W K), K boxes per pixel: [0, 0] relative (xmin, ymin, xmax, ymax), [0, 1] variances
    Fork: weiliu89/caffe (ssd), MhLiao/TextBoxes_plusplus, src/caffe/layers/prior_box_layer.cpp
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({0, 1})

    def setup(self) -> None:
        param = value(self.param, "prior_box_param")
        self.sizes = self.sizes_of(param)
        if len(param.variance) not in (0, 1, 4) or any(v <= 0 for v in param.variance):
            raise self.error("variance must be one number or four, each above 0", "prior_box_param", "variance")
        self.variances = np.array(list(param.variance) or [0.1], np.float32) * np.ones(4, np.float32)
        self.image = self._pair(param, "img_size", "img_h", "img_w")
        self.step = self._pair(param, "step", "step_h", "step_w")
        if self.image is None and len(self.bottom_shapes) < 2:
            message = "the image is missing: give it as a second bottom, or img_size, or img_h and img_w"
            raise self.error(message, "bottom")

    def sizes_of(self, param: Any) -> Array:
        """Return the widths and heights of the boxes of one pixel (K, 2). Raises SpecError for wrong ones."""
        if not param.min_size or min(param.min_size) < 1:
            raise self.error("min_size must be given and be at least 1", "prior_box_param", "min_size")
        if param.max_size and len(param.max_size) != len(param.min_size):
            message = f"found {len(param.max_size)} max_size, expected none or {len(param.min_size)}, one per min_size"
            raise self.error(message, "prior_box_param", "max_size")
        for i, (small, large) in enumerate(zip(param.min_size, param.max_size, strict=False)):
            if large <= small:
                message = f"max_size {large:g} must be greater than its min_size {small:g}"
                raise self.error(message, "prior_box_param", "max_size", i)
        self._warn_of_cut_sizes(param)
        sizes, ratios = [], self.ratios_of(param)
        for i, small in enumerate(map(self.pixels, param.min_size)):
            sizes.append((small, small))
            if param.max_size:
                sizes.append((math.sqrt(small * self.pixels(param.max_size[i])),) * 2)
            sizes += [(small * math.sqrt(ratio), small / math.sqrt(ratio)) for ratio in ratios[1:]]
        return np.array(sizes, np.float32)

    def ratios_of(self, param: Any) -> list[float]:
        """Return 1 and the other aspect ratios."""
        ratios = [1.0]
        for ratio in param.aspect_ratio:
            if ratio <= 0:
                raise self.error(f"aspect_ratio must be above 0, found {ratio:g}", "prior_box_param", "aspect_ratio")
            if all(abs(ratio - known) >= 1e-6 for known in ratios):
                ratios += [ratio, 1 / ratio] if param.flip else [ratio]
        return ratios

    def _warn_of_cut_sizes(self, param: Any) -> None:
        """Warn about truncated sizes, since other forks and OpenCV do not truncate them."""
        for name in ("min_size", "max_size"):
            sizes = getattr(param, name)
            cut = [f"{size:g} to {self.pixels(size):g}" for size in sizes if self.pixels(size) != size]
            if cut:
                where = self.context.at("prior_box_param", name, 0)
                found = f"{where}: {name} is cut to whole pixels, as in SSD: {', '.join(cut)}"
                log.logger.warning(f"{found}; OpenCV and some forks keep it, so a net trained there gives other boxes")

    def pixels(self, size: float) -> float:
        """Return the size of a box for a ``min_size`` or ``max_size``."""
        return int(size)

    def _pair(self, param: Any, both: str, height: str, width: str) -> tuple[float, float] | None:
        """Return (vertical, horizontal) of a setting given as one or two numbers, or None."""
        given = [name for name in (both, height, width) if param.HasField(name)]
        if not given:
            return None
        if given not in ([both], [height, width]) or any(getattr(param, name) <= 0 for name in given):
            message = f"expected {both}, or both {height} and {width}, above 0; found {' and '.join(given)}"
            raise self.error(message, "prior_box_param", given[0])
        return getattr(param, given[0]), getattr(param, given[-1])

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the boxes, and compute them."""
        if any(len(shape) != 4 for shape in bottom_shapes):
            raise self.error(f"found bottoms of shapes {bottom_shapes}, expected 4 axes (N, C, H, W)", "bottom")
        height, width = bottom_shapes[0][2:]
        image = self.image or bottom_shapes[1][2:]
        step = self.step or (image[0] / height, image[1] / width)
        param = value(self.param, "prior_box_param")
        offset = np.float32(param.offset)
        y = (np.arange(height, dtype=np.float32) + offset) * np.float32(step[0])
        x = (np.arange(width, dtype=np.float32) + offset) * np.float32(step[1])
        center = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)[:, :, None].astype(float)
        center, half = self.placed(center, self.sizes / 2.0, step[0])
        extent = np.array(image[::-1], float)
        boxes = np.concatenate([(center - half) / extent, (center + half) / extent], axis=-1).astype(np.float32)
        boxes = boxes.clip(0, 1) if param.clip else boxes
        self.boxes = np.stack([boxes.reshape(-1), np.tile(self.variances, boxes.size // 4)])[None]
        return [self.boxes.shape]

    def placed(self, center: Array, half: Array, step: float) -> tuple[Array, Array]:
        """Return the centers and half sizes of all boxes, from (H, W, 1, 2) centers and K half sizes; step of rows."""
        param = value(self.param, "prior_box_param")
        if not param.denser_prior_boxes:
            return center, half
        lower = center + np.array([0, (1 - float(np.float32(param.offset))) * step])
        return np.concatenate([center, lower] * len(half), axis=2), half.repeat(2, axis=0)

    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(self.boxes).to(bottoms[0])
