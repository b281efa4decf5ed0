"""Exporters of layers of netspec/dialects/ssd."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from netspec.export.exporter import Exporter, exports, rounded
from netspec.export.expression import Expression, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.proto.schema import value

CENTER_SIZE, CORNER_SIZE = 2, 3  # netspec/dialects/ssd/ssd.py: enum PriorBoxParameter.CodeType


def onnx_decode(graph: OnnxGraph, codes: str, priors: str, variances: str | None, code: int) -> str:
    """Write :func:`decode` for codes (..., P, 4) and priors and variances (1, P, 4)."""
    halves = graph.constant([2, 2])
    low, high = graph.nodes("Split", priors, halves, outputs=2, axis=-1)
    extent = graph.node("Sub", high, low)
    if variances is not None:
        codes = graph.node("Mul", codes, variances)
    first, second = graph.nodes("Split", codes, halves, outputs=2, axis=-1)
    if code == CENTER_SIZE:
        half = graph.constant(0.5)
        middle = graph.node("Mul", graph.node("Add", low, high), half)
        center = graph.node("Add", graph.node("Mul", first, extent), middle)
        reach = graph.node("Mul", graph.node("Mul", graph.node("Exp", second), extent), half)
        return graph.node("Concat", graph.node("Sub", center, reach), graph.node("Add", center, reach), axis=-1)
    if code == CORNER_SIZE:
        first, second = graph.node("Mul", first, extent), graph.node("Mul", second, extent)
    return graph.node("Concat", graph.node("Add", low, first), graph.node("Add", high, second), axis=-1)


@exports("netspec.dialects.ssd.detection.DetectionOutput")
class DetectionOutputExport(Exporter):
    def _exported(self, target: str, bottoms: Sequence[Any]) -> Any:
        """Return the parameters for an exported net; raise SpecError for unsupported ones."""
        param = value(self.layer.param, "detection_output_param")
        if param.nms_param.eta < 1:
            raise self.refusal(target, "its non-maximum suppression has a fixed threshold: eta must be 1")
        if len(bottoms) == 5:
            raise self.refusal(target, "its priors are refined")
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
        if param.code_type == CENTER_SIZE:
            areas = boxes
        else:  # ONNX takes the corners in any order; in Caffe, a box that is turned inside out overlaps nothing
            low, high = graph.nodes("Split", boxes, graph.constant([2, 2]), outputs=2, axis=-1)
            areas = graph.node("Concat", low, graph.node("Max", low, high), axis=-1)
        found = graph.node("NonMaxSuppression", areas, candidates, every, overlap, least)
        # Add a row that is not a detection, since OpenCV 5.0 crashes on empty tensors.
        found = graph.node("Concat", found, graph.constant([[0, 0, 0]]), axis=0)
        if param.keep_top_k > -1:
            found = self._onnx_best(graph, bottoms[0], scores, found, param.keep_top_k)
        return self._onnx_rows(graph, bottoms[0], boxes, scores, found, classes)

    def _onnx_boxes_and_scores(
        self, graph: OnnxGraph, bottoms: Sequence[str], classes: Sequence[int]
    ) -> tuple[str, str]:
        """Write boxes (N, P, 4) and scores (N, classes, P), or (N classes, 1, P) if each class has its own boxes."""
        param = value(self.layer.param, "detection_output_param")
        loc, conf, prior = bottoms[:3]
        codes = graph.node("Transpose", graph.reshape(loc, [0, -1, self.layer.kinds, 4]), perm=[0, 2, 1, 3])
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
        zeros = graph.node("Expand", graph.constant(0.0), shape)
        rows = graph.shape_of(found, 0, 1)
        zero, one = graph.constant(0), graph.constant(1)
        index = graph.node("Range", zero, graph.node("Squeeze", rows), one)
        is_last = graph.node("Equal", index, graph.node("Sub", rows, graph.constant([1])))
        counted = graph.node("Where", is_last, graph.constant(0.0), graph.constant(1.0))
        counted = graph.node("ScatterND", zeros, found, counted, reduction="add")
        confidence = graph.node("Where", graph.node("Greater", counted, graph.constant(0.5)), scores, lowest)
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
        if not value(self.layer.param, "detection_output_param").share_location:
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

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Expression:
        param = self._exported("PyTorch", bottoms)
        nms = param.nms_param
        if param.code_type != CENTER_SIZE or not param.share_location:
            raise self.refusal("PyTorch", "it is exported for code_type: CENTER_SIZE and share_location: true")
        options = {
            "classes": param.num_classes,
            "background": param.background_label_id,
            "overlap": rounded(nms.nms_threshold),
            **({"confidence": rounded(param.confidence_threshold)} if param.HasField("confidence_threshold") else {}),
            **({"candidates": nms.top_k} if nms.HasField("top_k") and nms.top_k > -1 else {}),
            **({"most": param.keep_top_k} if param.keep_top_k > -1 else {}),
            **({"encoded": True} if param.variance_encoded_in_target else {}),
        }
        return call(detection_output, *bottoms[:3], **options)


@exports("netspec.dialects.ssd.priors.PriorBox")
class PriorBoxExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        image_is_free = layer.image is None and None in graph.sizes(1)[2:]
        if None not in graph.sizes(0)[2:] and not image_is_free:
            return graph.node("Identity", graph.constant(layer.boxes))
        if value(layer.param, "prior_box_param").denser_prior_boxes:
            raise self.refusal("ONNX", "denser_prior_boxes is exported for maps of one size")
        sides = []
        for k in (0, 1):  # vertical, horizontal
            count = graph.shape_of(bottoms[0], 2 + k, 3 + k)
            if layer.image:
                extent = graph.constant([float(layer.image[k])])
            else:
                extent = graph.cast(graph.shape_of(bottoms[1], 2 + k, 3 + k), "float32")
            if layer.step:
                step = graph.constant([float(layer.step[k])])
            else:
                step = graph.node("Div", extent, graph.cast(count, "float32"))
            zero, one = graph.constant(0), graph.constant(1)
            index = graph.cast(graph.node("Range", zero, graph.node("Squeeze", count), one), "float32")
            offset = graph.constant(value(layer.param, "prior_box_param").offset)
            center = graph.node("Mul", graph.node("Add", index, offset), step)
            center = graph.reshape(center, [-1, 1, 1] if k == 0 else [1, -1, 1])
            half = graph.constant(layer.sizes[:, 1 - k] / np.float32(2))
            sides.append([graph.node("Div", graph.node(op, center, half), extent) for op in ("Sub", "Add")])
        (top, bottom), (left, right) = sides
        down, across = graph.shape_of(bottoms[0], 2, 3), graph.shape_of(bottoms[0], 3, 4)
        shape = graph.node("Concat", down, across, graph.constant([len(layer.sizes)]), axis=0)
        last = graph.constant([3])
        corners = [
            graph.node("Unsqueeze", graph.node("Expand", side, shape), last) for side in (left, top, right, bottom)
        ]
        boxes = graph.node("Concat", *corners, axis=3)
        if value(layer.param, "prior_box_param").clip:
            boxes = graph.node("Clip", boxes, graph.constant(0.0), graph.constant(1.0))
        variances = graph.node("Expand", graph.constant(layer.variances), graph.shape_of(boxes))
        return graph.node("Concat", *(graph.reshape(part, [1, 1, -1]) for part in (boxes, variances)), axis=1)

    def to_torch(self, code: TorchCode, x: Expression, *image: Expression) -> Expression:
        layer = self.layer
        param = value(layer.param, "prior_box_param")
        if param.denser_prior_boxes:
            raise self.refusal("PyTorch", "it has denser_prior_boxes")
        options = {
            "sizes": [(rounded(float(width)), rounded(float(height))) for width, height in layer.sizes],
            "variances": tuple(rounded(float(v)) for v in layer.variances),
            **({"step": layer.step} if layer.step else {}),
            **({"offset": rounded(param.offset)} if param.offset != 0.5 else {}),
            **({"clip": True} if param.clip else {}),
        }
        return call(prior_boxes, x, layer.image or image[0].shape[2:], **options)


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
    boxes = boxes[torch.arange(images, device=loc.device)[:, None, None], order]
    kept = (scores > confidence) & ~suppressed(boxes, overlap)
    kept = kept & (torch.arange(classes, device=loc.device) != background)[:, None]
    if most is not None:
        ranked = torch.where(kept, scores, -torch.inf).flatten(1)
        best = ranked.argsort(dim=1, descending=True, stable=True)[:, :most]
        chosen = torch.zeros_like(ranked, dtype=torch.bool).scatter(1, best, True)
        kept = kept & chosen.reshape(kept.shape)
    image, label, _ = kept.nonzero(as_tuple=True)
    found = [image[:, None], label[:, None], scores[kept][:, None], boxes[kept]]
    nothing = loc.new_full((images, 7), -1.0)
    nothing[:, 0] = torch.arange(images, device=loc.device)
    rows = torch.cat([torch.cat(found, 1), nothing])
    counted = torch.cat([kept[kept], (~kept.any()).expand(images)])
    return rows[counted][None, None]


def prior_boxes(x, image, sizes, variances, step=None, offset=0.5, clip=False):
    """Return boxes with these sizes (width, height) around the center of every pixel of x, relative to the image.

    (1, 2, 4 H W K) for K sizes: the boxes (xmin, ymin, xmax, ymax) and their variances.
    """
    height, width = x.shape[2:]
    down, across = step or (image[0] / height, image[1] / width)
    options = {"dtype": torch.float64, "device": x.device}
    y = (torch.arange(height, **options) + offset) * down
    x = (torch.arange(width, **options) + offset) * across
    center = torch.stack(torch.broadcast_tensors(x, y[:, None]), 2)[:, :, None]
    half = torch.tensor(sizes, **options) / 2
    boxes = torch.cat([center - half, center + half], 3)
    boxes = (boxes / torch.tensor([image[1], image[0]] * 2, **options)).float()
    boxes = boxes.clamp(0, 1) if clip else boxes
    variance = torch.tensor(variances, device=boxes.device).expand_as(boxes)
    return torch.stack([boxes.flatten(), variance.flatten()])[None]
