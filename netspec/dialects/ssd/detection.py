"""SSD's DetectionOutput, which converts boxes and scores to detections."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from netspec.dialects.boxes import (
    Array,
    as_array,
    check_predictions,
    decode,
    detections,
    highest,
    suppress,
)
from netspec.dialects.checks import check_at_least_1
from netspec.layers import Layer
from netspec.layers.contract.base import Shape
from netspec.proto.schema import value


class DetectionOutput(Layer):
    """Decode the predicted boxes, and apply non-maximum suppression to each class.

    With five bottoms it is RefineDet's: the priors are first refined, and priors whose confidence of an object is below
    ``objectness_score`` are left out.

    bottom[0]  predicted boxes (N, 4 P) for P priors; (N, 4 P num_classes) if share_location is false
    bottom[1]  confidences (N, P num_classes)
    bottom[2]  priors and variances (1, 2, 4 P)
    bottom[3]  optional: the images, in which the fork draws the boxes; not used. RefineDet's: confidences (N, 2 P) of
               no object and of an object
    bottom[4]  RefineDet's: the boxes (N, 4 P) that refine the priors
    top[0]     (1, 1, D, 7): image, label, confidence, xmin, ymin, xmax, ymax of D detections; D is 1 before the first
               pass. If nothing is found, a row (image, -1, -1, ...) for each image. Its gradient is ignored.
    Fork: src/caffe/layers/detection_output_layer.cpp, also of sfzhang15/RefineDet
    """

    bottoms = (3, 5)
    counted_axis = 2
    label_bottoms = frozenset(range(5))
    ignores = frozenset(
        f"detection_output_param.{name}"
        for name in ("save_output_param", "visualize", "visualize_threshold", "save_file")
    )

    def setup(self) -> None:
        param = value(self.param, "detection_output_param")
        check_at_least_1(self, "detection_output_param", "num_classes")
        if param.nms_param.nms_threshold < 0:
            message = "nms_threshold must not be negative"
            raise self.error(message, "detection_output_param", "nms_param", "nms_threshold")
        if not 0 < param.nms_param.eta <= 1:
            raise self.error("eta must be above 0, at most 1", "detection_output_param", "nms_param", "eta")
        self.kinds = 1 if param.share_location else param.num_classes

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of one detection; the predictions must match the priors."""
        param = value(self.param, "detection_output_param")
        self.priors = check_predictions(self, bottom_shapes, self.kinds, param.num_classes)
        for i, each in ((3, 2), (4, 4)) if len(bottom_shapes) == 5 else ():
            if math.prod(bottom_shapes[i]) != bottom_shapes[0][0] * self.priors * each:
                message = f"found a bottom of shape {bottom_shapes[i]}, expected ({bottom_shapes[0][0]}, {each} P)"
                raise self.error(f"{message} for {self.priors} priors", "bottom", i)
        return [(1, 1, 1, 7)]

    def forward(self, loc: torch.Tensor, conf: torch.Tensor, prior: torch.Tensor, *more: torch.Tensor) -> torch.Tensor:
        param = value(self.param, "detection_output_param")
        priors, variances = as_array(prior).reshape(2, self.priors, 4)
        codes = as_array(loc).reshape(-1, self.priors, self.kinds, 4)
        scores = as_array(conf).reshape(-1, self.priors, param.num_classes)
        scale = None if param.variance_encoded_in_target else variances
        refined = [priors] * len(codes)
        if len(more) == 2:
            objects, steps = (as_array(bottom).reshape(len(codes), self.priors, -1) for bottom in more)
            scores = scores * (objects[..., 1:] >= np.float32(param.objectness_score))
            refined = [decode(each, priors, scale, param.code_type) for each in steps]
        rows = []
        for i in range(len(codes)):
            boxes = [decode(codes[i, :, kind], refined[i], scale, param.code_type) for kind in range(self.kinds)]
            rows.append(self._detect(i, boxes, scores[i]))
        return detections(rows, loc)

    def _detect(self, image: int, boxes: list[Array], scores: Array) -> Array:
        """Return the detections of one image, by label and decreasing confidence: (d, 7)."""
        param = value(self.param, "detection_output_param")
        nms, rows = param.nms_param, [np.zeros((0, 7), np.float32)]
        for label in range(param.num_classes):
            if label == param.background_label_id:
                continue
            own, score = boxes[0 if param.share_location else label], scores[:, label]
            order = np.argsort(-score, kind="stable")
            if param.HasField("confidence_threshold"):
                order = order[score[order] > param.confidence_threshold]
            if nms.HasField("top_k") and nms.top_k > -1:
                order = order[: nms.top_k]
            kept = order[suppress(own[order], nms.nms_threshold, nms.eta)]
            head = np.stack([np.full(len(kept), image), np.full(len(kept), label), score[kept]], axis=1)
            rows.append(np.concatenate([head.astype(np.float32), own[kept]], axis=1))
        found = np.concatenate(rows)
        if -1 < param.keep_top_k < len(found):
            found = found[highest(found[:, 2], param.keep_top_k)]
            found = found[np.argsort(found[:, 1], kind="stable")]
        return found
