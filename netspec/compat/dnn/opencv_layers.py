"""Layers of SSD as OpenCV computes them: what it puts out differs from the fork's layers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from netspec.dialects.ssd import ssd
from netspec.layers.contract.base import Shape
from netspec.proto.schema import value


class PriorBox(ssd.PriorBox):
    """SSD's, but sizes that are no whole pixels stay as they are, and boxes are clipped unless ``clip`` is false.

    With bottom[1] the image is always its size, whatever img_size, img_h and img_w say.
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
        """Lay the boxes, and clip them where nothing is said."""
        shapes = super().reshape(bottom_shapes)
        if not value(self.param, "prior_box_param").HasField("clip"):
            self.boxes[0, 0] = self.boxes[0, 0].clip(0, 1)
        return shapes


class DetectionOutput(ssd.DetectionOutput):
    """SSD's, but each image's rows in the order of confidence, and always as many rows as may be kept.

    top[0]     (1, 1, N keep_top_k, 7): the detections of all images, then rows of zeros
    OpenCV: modules/dnn/src/layers/detection_output_layer.cpp. It refuses a net without keep_top_k; here the rows are
    then those that are found, one of zeros where there are none.
    """

    type = "DetectionOutput"

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape with room for all detections that may be kept."""
        super().reshape(bottom_shapes)
        return [(1, 1, max(bottom_shapes[0][0] * value(self.param, "detection_output_param").keep_top_k, 1), 7)]

    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        """Return the detections, then rows of zeros."""
        rows = super().forward(*bottoms)[0, 0]
        rows = rows[rows[:, 1] >= 0]  # without the fork's row (image, -1, ...) for none
        rows = rows[torch.argsort(rows[:, 2], descending=True, stable=True)]
        rows = rows[torch.argsort(rows[:, 0], stable=True)]
        return F.pad(rows, (0, 0, 0, max(self.top_shapes[0][2] - len(rows), 0)))[None, None]


LAYERS = {cls.type: cls for cls in (PriorBox, DetectionOutput)}
