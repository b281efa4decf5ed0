"""SSD's DetectionOutput, which converts boxes and scores to detections, also in exported nets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from netspec.dialects.boxes import (
    CENTER_SIZE,
    Array,
    as_array,
    check_predictions,
    decode,
    detections,
    highest,
    onnx_decode,
    suppress,
)
from netspec.layers import Layer
from netspec.layers.contract.base import Shape
from netspec.layers.contract.exporting import refusal
from netspec.layers.contract.targets import OnnxGraph, TorchCode, rounded
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
        if param.num_classes < 1:
            raise self.error("num_classes must be given", "detection_output_param", "num_classes")
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

    def _exported(self, target: str, bottoms: Sequence[str]) -> Any:
        """Return the parameters for an exported net; raise SpecError for unsupported ones."""
        param = value(self.param, "detection_output_param")
        if param.nms_param.eta < 1:
            raise refusal(self, target, "its non-maximum suppression has a fixed threshold: eta must be 1")
        if len(bottoms) == 5:
            raise refusal(self, target, "its priors are refined")
        return param

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        param = self._exported("ONNX", bottoms)
        nms = param.nms_param
        classes = [label for label in range(param.num_classes) if label != param.background_label_id]
        boxes, scores = self._onnx_boxes_and_scores(graph, bottoms, classes)
        lowest = graph.constant(float(np.finfo(np.float32).min))
        every = graph.shape_of(scores, 2, 3)
        candidates = scores
        if nms.HasField("top_k") and nms.top_k > -1:
            most = graph.node("Min", graph.constant([nms.top_k]), every)
            best, places = graph.nodes("TopK", scores, most, outputs=2, axis=2)
            none = graph.node("Expand", lowest, graph.shape_of(scores))
            candidates = graph.node("ScatterElements", none, places, best, axis=2)
        least = graph.constant([param.confidence_threshold]) if param.HasField("confidence_threshold") else lowest
        overlap = graph.constant([min(nms.nms_threshold, 1.0)])
        found = graph.node("NonMaxSuppression", boxes, candidates, every, overlap, least)
        # Add a row that is not a detection, since OpenCV 5.0 crashes on empty tensors.
        found = graph.node("Concat", found, graph.constant([[0, 0, 0]]), axis=0)
        if param.keep_top_k > -1:
            found = self._onnx_best(graph, bottoms[0], scores, found, param.keep_top_k)
        return self._onnx_rows(graph, bottoms[0], boxes, scores, found, classes)

    def _onnx_boxes_and_scores(
        self, graph: OnnxGraph, bottoms: Sequence[str], classes: Sequence[int]
    ) -> tuple[str, str]:
        """Write boxes (N, P, 4) and scores (N, classes, P), or (N classes, 1, P) if each class has its own boxes."""
        param = value(self.param, "detection_output_param")
        loc, conf, prior = bottoms[:3]
        codes = graph.node("Transpose", graph.reshape(loc, [0, -1, self.kinds, 4]), perm=[0, 2, 1, 3])
        pair = graph.constant([1, 1])
        priors, variances = graph.nodes("Split", graph.reshape(prior, [2, -1, 4]), pair, outputs=2, axis=0)
        boxes = onnx_decode(
            graph, codes, priors, None if param.variance_encoded_in_target else variances, param.code_type
        )
        scores = graph.node("Transpose", graph.reshape(conf, [0, -1, param.num_classes]), perm=[0, 2, 1])
        kept = graph.constant(classes)
        scores = graph.node("Gather", scores, kept, axis=1)
        if param.share_location:
            return graph.node("Squeeze", boxes, graph.constant([1])), scores
        all_of_them, one = graph.constant([-1]), graph.constant([1])
        boxes = graph.node("Gather", boxes, kept, axis=1)
        shape = graph.node("Concat", all_of_them, graph.shape_of(boxes, 2, 4), axis=0)
        flat = graph.node("Concat", all_of_them, one, graph.shape_of(scores, 2, 3), axis=0)
        return graph.node("Reshape", boxes, shape), graph.node("Reshape", scores, flat)

    @staticmethod
    def _onnx_best(graph: OnnxGraph, loc: str, scores: str, found: str, most: int) -> str:
        """Write which of the detections (D + 1, 3) are among the ``most`` confident of their image, in order.

        The last row is always kept.
        """
        shape = graph.shape_of(scores)
        lowest = graph.constant(float(np.finfo(np.float32).min))
        none = graph.node("Expand", lowest, shape)
        rows = graph.shape_of(found, 0, 1)
        zero, one = graph.constant(0), graph.constant(1)
        index = graph.node("Range", zero, graph.node("Squeeze", rows), one)
        is_last = graph.node("Equal", index, graph.node("Sub", rows, graph.constant([1])))
        confidence = graph.node("Where", is_last, lowest, graph.node("GatherND", scores, found))
        confidence = graph.node("ScatterND", none, found, confidence, reduction="max")
        by_image = graph.node("Concat", graph.shape_of(loc, 0, 1), graph.constant([-1]), axis=0)
        confidence = graph.node("Reshape", confidence, by_image)
        count = graph.node("Min", graph.constant([most]), graph.shape_of(confidence, 1, 2))
        best, places = graph.nodes("TopK", confidence, count, outputs=2, axis=1)
        ones = graph.node("Expand", graph.constant(1.0), graph.shape_of(best))
        zeros = graph.node("Expand", graph.constant(0.0), graph.shape_of(confidence))
        chosen = graph.node("Reshape", graph.node("ScatterElements", zeros, places, ones, axis=1), shape)
        kept = graph.node(
            "NonZero", graph.node("Where", is_last, graph.constant(1.0), graph.node("GatherND", chosen, found))
        )
        return graph.node("Gather", found, graph.node("Squeeze", kept, graph.constant([0])), axis=0)

    def _onnx_rows(
        self, graph: OnnxGraph, loc: str, boxes: str, scores: str, found: str, classes: Sequence[int]
    ) -> str:
        """Write the top: a row for each detection (item, class, box) except the last; without any, one per image."""
        thirds = graph.constant([1, 1, 1])
        item, column, box = graph.nodes("Split", found, thirds, outputs=3, axis=1)
        corners = graph.node("GatherND", boxes, graph.node("Concat", item, box, axis=1))
        if not value(self.param, "detection_output_param").share_location:
            count = graph.constant(len(classes))
            item, column = graph.node("Div", item, count), graph.node("Mod", item, count)
        label = graph.node("Gather", graph.constant([float(label) for label in classes]), column, axis=0)
        confidence = graph.node("Unsqueeze", graph.node("GatherND", scores, found), graph.constant([1]))
        rows = graph.node("Concat", graph.cast(item, "float32"), label, confidence, corners, axis=1)
        images = graph.shape_of(loc, 0, 1)
        zero, one = graph.constant(0), graph.constant(1)
        index = graph.cast(graph.node("Range", zero, graph.node("Squeeze", images), one), "float32")
        six = graph.node("Expand", graph.constant(-1.0), graph.node("Concat", images, graph.constant([6]), axis=0))
        nothing = graph.node("Concat", graph.reshape(index, [-1, 1]), six, axis=1)
        found_any = graph.node("Greater", graph.shape_of(found, 0, 1), graph.constant([1]))
        start = graph.node("Mul", images, graph.cast(found_any, "int64"))
        end = graph.node("Where", found_any, graph.constant([-1]), images)  # without the last row, or without any
        rows = graph.node("Concat", nothing, rows, axis=0)
        rows = graph.node("Slice", rows, start, end, graph.constant([0]))
        return graph.node("Unsqueeze", rows, graph.constant([0, 1]))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        param = self._exported("PyTorch", bottoms)
        nms = param.nms_param
        if param.code_type != CENTER_SIZE or not param.share_location:
            raise refusal(self, "PyTorch", "it is exported for code_type: CENTER_SIZE and share_location: true")
        code.function(decode_boxes)
        code.function(suppressed)
        options = {
            "classes": param.num_classes,
            "background": param.background_label_id,
            "overlap": rounded(nms.nms_threshold),
            **({"confidence": rounded(param.confidence_threshold)} if param.HasField("confidence_threshold") else {}),
            **({"candidates": nms.top_k} if nms.HasField("top_k") and nms.top_k > -1 else {}),
            **({"most": param.keep_top_k} if param.keep_top_k > -1 else {}),
            **({"encoded": True} if param.variance_encoded_in_target else {}),
        }
        given = ", ".join(f"{name}={{{name}}}" for name in options)
        template = f"{code.function(detection_output)}({', '.join(bottoms[:3])}, {given})"
        return code.call(template, **options)


# These functions are copied into exported source code, in which only unusual settings are written.


def decode_boxes(codes, priors, variances):
    """Return boxes (xmin, ymin, xmax, ymax) from codes relative to priors: center and logarithm of the size."""
    low, high = priors.chunk(2, dim=-1)
    shift, growth = (codes * variances).chunk(2, dim=-1)
    center = (low + high) / 2 + shift * (high - low)
    half = growth.exp() * (high - low) / 2
    return torch.cat([center - half, center + half], dim=-1)


def suppressed(boxes, overlap):
    """Return which boxes (..., K, 4), in this order, overlap one kept before by more than a share of their union."""
    low = torch.maximum(boxes[..., :, None, :2], boxes[..., None, :, :2])
    high = torch.minimum(boxes[..., :, None, 2:], boxes[..., None, :, 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    area = (boxes[..., 2:] - boxes[..., :2]).clamp(min=0).prod(-1)
    union = area[..., :, None] + area[..., None, :] - shared
    over = (shared > overlap * union).triu(1)
    gone = torch.zeros_like(area, dtype=torch.bool)
    for k in range(boxes.shape[-2] - 1):
        gone = gone | over[..., k, :] & ~gone[..., k, None]
    return gone


def detection_output(
    loc, conf, prior, classes, background, overlap, confidence=-torch.inf, candidates=None, most=None, encoded=False
):
    """Return rows (image, label, confidence, xmin, ymin, xmax, ymax): (1, 1, D, 7).

    Of each class the boxes of highest confidence that overlap none of a higher one; where
    nothing is found, a row of -1 for each image.
    """
    images = loc.shape[0]
    priors, variances = prior.reshape(2, -1, 4)
    variances = 1 if encoded else variances
    boxes = decode_boxes(loc.reshape(images, -1, 4), priors, variances)
    scores = conf.reshape(images, -1, classes).transpose(1, 2)
    scores, order = scores.sort(dim=2, descending=True, stable=True)
    scores, order = scores[..., :candidates], order[..., :candidates]
    boxes = boxes[torch.arange(images)[:, None, None], order]
    kept = (scores > confidence) & ~suppressed(boxes, overlap)
    kept = kept & (torch.arange(classes) != background)[:, None]
    if most is not None:
        ranked = torch.where(kept, scores, -torch.inf).flatten(1)
        best = ranked.argsort(dim=1, descending=True, stable=True)[:, :most]
        chosen = torch.zeros_like(ranked, dtype=torch.bool).scatter(1, best, True)
        kept = kept & chosen.reshape(kept.shape)
    image, label, _ = kept.nonzero(as_tuple=True)
    found = [image[:, None], label[:, None], scores[kept][:, None], boxes[kept]]
    nothing = torch.full((images, 7), -1.0)
    nothing[:, 0] = torch.arange(images)
    rows = torch.cat([torch.cat(found, 1), nothing])
    counted = torch.cat([kept[kept], (~kept.any()).expand(images)])
    return rows[counted][None, None]
