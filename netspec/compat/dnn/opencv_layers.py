"""SSD's layers as OpenCV computes them; the outputs differ from those of the fork's layers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from netspec.dialects.ssd import ssd
from netspec.layers.contract.base import Shape
from netspec.proto.schema import value


class PriorBox(ssd.PriorBox):
    """Like SSD's layer, but sizes are not rounded to pixels, and boxes are clipped unless ``clip`` is false.

    With bottom[1], the image size is always that of bottom[1]; img_size, img_h and img_w are ignored.
    OpenCV: modules/dnn/src/layers/prior_box_layer.cpp
    """

    type = "PriorBox"

    def setup(self) -> None:
        """Take the image's size from bottom[1]."""
        super().setup()
        self.image = None if len(self.bottom_shapes) > 1 else self.image

    def pixels(self, size: float) -> float:
        """Return the size itself."""
        return size

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Compute the boxes, and clip them by default."""
        shapes = super().reshape(bottom_shapes)
        if not value(self.param, "prior_box_param").HasField("clip"):
            self.boxes[0, 0] = self.boxes[0, 0].clip(0, 1)
        return shapes


class DetectionOutput(ssd.DetectionOutput):
    """Like SSD's layer, but the rows of each image are in order of confidence, and the number of rows is fixed.

    top[0]     (1, 1, N keep_top_k, 7): the detections of all images, then rows of zeros
    OpenCV: modules/dnn/src/layers/detection_output_layer.cpp. OpenCV refuses a net without keep_top_k; here it gets
    as many rows as are found, or one row of zeros.
    """

    type = "DetectionOutput"

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape for the largest number of detections."""
        super().reshape(bottom_shapes)
        return [(1, 1, max(bottom_shapes[0][0] * value(self.param, "detection_output_param").keep_top_k, 1), 7)]

    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        """Return the detections, followed by rows of zeros."""
        rows = super().forward(*bottoms)[0, 0]
        rows = rows[rows[:, 1] >= 0]  # without the fork's row (image, -1, ...) for none
        rows = rows[torch.argsort(rows[:, 2], descending=True, stable=True)]
        rows = rows[torch.argsort(rows[:, 0], stable=True)]
        return F.pad(rows, (0, 0, 0, max(self.top_shapes[0][2] - len(rows), 0)))[None, None]


LAYERS = {cls.type: cls for cls in (PriorBox, DetectionOutput)}
