"""YOLO in Caffe, versions 2 and 3: eric612/MobileNet-YOLO and similar forks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from typing_extensions import override

from netspec.dialects.boxes import Array, around, as_array, detections, overlaps, sigmoid
from netspec.dialects.gradients import with_gradient_of
from netspec.dialects.yolo.region_loss import CLASSES, OBJECT, RegionLoss, Yolov3, read_anchors
from netspec.layers import Layer, register
from netspec.layers.activation import Activation
from netspec.layers.contract.base import Shape
from netspec.proto.schema import value

DECLARATIONS = """
message YoloDetectionOutputParameter {
  optional uint32 side = 1 [default = 13];
  optional uint32 num_classes = 2 [default = 20];
  optional uint32 num_box = 3 [default = 5];
  optional uint32 coords = 4 [default = 4];
  optional float confidence_threshold = 5 [default = 0.01];
  optional float nms_threshold = 6 [default = 0.45];
  repeated float biases = 7;
  optional string label_map_file = 8;
}
message Yolov3DetectionOutputParameter {
  optional uint32 num_classes = 1 [default = 20];
  optional uint32 num_box = 2 [default = 3];
  optional float confidence_threshold = 3 [default = 0.01];
  optional float nms_threshold = 4 [default = 0.45];
  repeated float biases = 5;
  repeated uint32 anchors_scale = 6;
  optional uint32 mask_group_num = 7 [default = 2];
  repeated uint32 mask = 8;
}
message RegionLossParameter {
  optional uint32 side = 1 [default = 13];
  optional uint32 num_class = 2 [default = 20];
  optional uint32 bias_match = 3 [default = 1];
  optional uint32 coords = 4 [default = 4];
  optional uint32 num = 5 [default = 5];
  optional uint32 softmax = 6 [default = 1];
  optional float jitter = 7 [default = 0.2];
  optional uint32 rescore = 8 [default = 1];
  optional float object_scale = 9 [default = 1];
  optional float class_scale = 10 [default = 1];
  optional float noobject_scale = 11 [default = 0.5];
  optional float coord_scale = 12 [default = 5];
  optional uint32 absolute = 13 [default = 1];
  optional float thresh = 14 [default = 0.2];
  optional uint32 random = 15 [default = 1];
  repeated float biases = 16;
  optional string softmax_tree = 17;
  optional string class_map = 18;
}
message Yolov3Parameter {
  enum IOU_LOSS { IOU = 0; GIOU = 1; MSE = 2; DIOU = 3; CIOU = 4; }
  optional uint32 side = 1 [default = 13];
  optional uint32 num_class = 2 [default = 20];
  optional uint32 num = 3 [default = 5];
  optional float object_scale = 4 [default = 1.0];
  optional float class_scale = 5 [default = 1.0];
  optional float noobject_scale = 6 [default = 0.5];
  optional float coord_scale = 7 [default = 5.0];
  optional float thresh = 8 [default = 0.2];
  optional uint32 anchors_scale = 9 [default = 32];
  repeated float biases = 11;
  repeated uint32 mask = 12;
  optional bool use_logic_gradient = 13 [default = false];
  optional bool use_focal_loss = 14 [default = false];
  optional IOU_LOSS iou_loss = 15 [default = MSE];
  optional float iou_normalizer = 16 [default = 0.25];
  optional float iou_thresh = 17 [default = 0.5];
  optional float max_delta = 18 [default = 10];
  optional bool accumulate = 19 [default = true];
  optional float label_smooth_eps = 20 [default = 0.1];
}
extend LayerParameter {
  optional Yolov3Parameter yolov3_param = 1197;
  optional RegionLossParameter region_loss_param = 1200;
  optional YoloDetectionOutputParameter yolo_detection_output_param = 1198;
  optional Yolov3DetectionOutputParameter yolov3_detection_output_param = 1199;
}
"""

register("RegionLoss", "region_loss_param")(RegionLoss)
register("Yolov3", "yolov3_param")(Yolov3)


class _YoloOutput(Layer):
    """Base of the layers that turn YOLO's maps into detections, in the format of SSD's DetectionOutput.

    A map has ``num_box`` boxes per cell, each with 5 + num_classes channels: x, y, width, height, object, classes. A
    box that overlaps a more confident one of any label by ``nms_threshold`` or more is dropped. The fork treats all
    images of a batch as one; here each image has its own detections.
    """

    group: str
    counted_axis = 2
    bottoms = (1, None)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of one detection; the maps must have the channels of their boxes."""
        p = value(self.param, self.group)
        channels = p.num_box * (CLASSES + p.num_classes)
        for i, shape in enumerate(bottom_shapes):
            if len(shape) != 4 or shape[1] != channels or shape[0] != bottom_shapes[0][0] or not shape[0]:
                sizes = f"(N, {channels}, H, W): {p.num_box} boxes of {CLASSES} + {p.num_classes} channels"
                raise self.error(f"found a bottom of shape {shape}, expected {sizes}", "bottom", i)
        return [(1, 1, 1, 7)]

    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        p = value(self.param, self.group)
        rows = []
        for image in range(len(bottoms[0])):
            found = [self._detected(i, self._cells(bottom[image])) for i, bottom in enumerate(bottoms)]
            rows.append(self._suppressed(image, np.concatenate(found), p.nms_threshold))
        top = detections(rows, bottoms[0])
        self.top_shapes = [tuple(top.shape)]
        return top

    def _cells(self, maps: torch.Tensor) -> Array:
        """Return the maps of an image as (H, W, boxes, 5 + classes)."""
        boxes = value(self.param, self.group).num_box
        return as_array(maps).reshape(boxes, -1, *maps.shape[1:]).transpose(2, 3, 0, 1)

    def _detected(self, bottom: int, cells: Array) -> Array:
        """Return the detections of a map (d, 6): label, confidence, x, y, width, height as fractions of the image."""
        raise NotImplementedError

    @staticmethod
    def _centers(cells: Array) -> Array:
        """Return x and y of the boxes: (H, W, boxes, 2)."""
        height, width = cells.shape[:2]
        y, x = np.mgrid[:height, :width].astype(np.float32)
        return (np.stack([x, y], -1)[:, :, None] + sigmoid(cells[..., :2])) / np.array([width, height], np.float32)

    @staticmethod
    def _suppressed(image: int, found: Array, threshold: float) -> Array:
        """Return the detections after non-maximum suppression, as rows of SSD's DetectionOutput (k, 7).

        The most confident comes first.
        """
        found = found[np.argsort(-found[:, 1], kind="stable")]
        corners = around(found[:, 2:4], found[:, 4:6])
        kept: list[int] = []
        removed = np.zeros(len(found), bool)
        for i in range(len(found)):
            if not removed[i]:
                kept.append(i)
                removed |= overlaps(corners[i], corners) >= np.float32(threshold)
        numbers = np.full((len(kept), 1), image)
        return np.concatenate([numbers, found[kept, :2] + [1, 0], corners[kept]], axis=1, dtype=np.float32)


@register("YoloDetectionOutput", "yolo_detection_output_param")
class YoloDetectionOutput(_YoloOutput):
    """Turn YOLO v2's maps into detections: the most probable class of each box, times the probability of an object.

    Sizes are exp(w) and exp(h) times ``biases``, which are in cells.

    bottom[i]  (N, num_box (5 + num_classes), H, W)
    top[0]     (1, 1, d, 7): image, label (from 1), confidence, xmin, ymin, xmax, ymax; (image, -1, ...) without any
    Fork: eric612/MobileNet-YOLO, src/caffe/layers/yolo_detection_output_layer.cpp
    """

    group = "yolo_detection_output_param"

    def setup(self) -> None:
        param = value(self.param, self.group)
        self.anchors = read_anchors(self, self.group)
        if len(self.anchors) != param.num_box or param.coords != OBJECT:
            found = f"found {len(self.anchors)} and coords {param.coords}"
            message = f"expected a pair of biases for each of num_box {param.num_box}, and coords 4; {found}"
            raise self.error(message, self.group, "biases")

    @override
    def _detected(self, bottom: int, cells: Array) -> Array:
        height, width = cells.shape[:2]
        powers = np.exp(cells[..., CLASSES:] - cells[..., CLASSES:].max(axis=-1, keepdims=True))
        classes = powers / powers.sum(axis=-1, keepdims=True)
        confidence = sigmoid(cells[..., OBJECT]) * classes.max(axis=-1)
        sizes = np.exp(cells[..., 2:4]) * self.anchors / np.array([width, height], np.float32)
        columns = [classes.argmax(axis=-1)[..., None], confidence[..., None], self._centers(cells), sizes]
        rows = np.concatenate(columns, axis=-1, dtype=np.float32).reshape(-1, 6)
        return rows[rows[:, 1] >= np.float32(value(self.param, self.group).confidence_threshold)]


@register("Yolov3DetectionOutput", "yolov3_detection_output_param")
class Yolov3DetectionOutput(_YoloOutput):
    """Turn YOLO v3's maps into detections: classes of boxes with a sufficient class times object probability.

    Map i has the prior boxes in the i-th part of ``mask``; their ``biases`` are in pixels of an image of
    ``anchors_scale``[i] times the map's size.

    bottom[i]  (N, num_box (5 + num_classes), H, W)
    top[0]     (1, 1, d, 7): image, label (from 1), confidence, xmin, ymin, xmax, ymax; (image, -1, ...) without any
    Fork: eric612/MobileNet-YOLO, src/caffe/layers/yolov3_detection_output_layer.cpp
    """

    group = "yolov3_detection_output_param"

    def setup(self) -> None:
        param = value(self.param, self.group)
        anchors, maps = read_anchors(self, self.group), len(self.bottom_shapes)
        if param.mask_group_num != maps or len(param.anchors_scale) < maps:
            found = f"found mask_group_num {param.mask_group_num} and {len(param.anchors_scale)} anchors_scale"
            message = f"expected mask_group_num {maps}, the number of bottoms, and an anchors_scale for each; {found}"
            raise self.error(message, self.group, "mask_group_num")
        if len(param.mask) != maps * param.num_box or max(param.mask, default=0) >= len(anchors):
            expected = f"{maps} x num_box {param.num_box} numbers below {len(anchors)}, the pairs of biases"
            raise self.error(f"found mask {list(param.mask)}, expected {expected}", self.group, "mask")
        self.anchors = anchors[list(param.mask)].reshape(maps, param.num_box, 2)

    @override
    def _detected(self, bottom: int, cells: Array) -> Array:
        param = value(self.param, self.group)
        height, width = cells.shape[:2]
        confidence = sigmoid(cells[..., CLASSES:]) * sigmoid(cells[..., OBJECT, None])
        image = np.array([width, height], np.float32) * param.anchors_scale[bottom]
        boxes = np.concatenate([self._centers(cells), np.exp(cells[..., 2:4]) * self.anchors[bottom] / image], axis=-1)
        found = np.nonzero(confidence > np.float32(param.confidence_threshold))
        columns = [found[3][:, None], confidence[found][:, None], boxes[found[:3]]]
        return np.concatenate(columns, axis=1, dtype=np.float32)


@register("HardSigmoid")
class HardSigmoid(Activation):
    """min(max(0.2 x + 0.5, 0), 1); the gradient is 0.2 everywhere, because the fork tests the top.

    bottom[0]  any shape
    top[0]     the same shape
    Fork: eric612/MobileNet-YOLO, src/caffe/layers/hard_sigmoid_layer.cpp
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return with_gradient_of(lambda: 0.2 * x, (0.2 * x + 0.5).clamp(0, 1))
