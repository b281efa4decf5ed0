"""SSD, the single shot detector: weiliu89/caffe, branch ssd.

A database for its layer AnnotatedData is what the fork's convert_annoset writes: records of AnnotatedDatum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from netspec.dialects._annotated import AnnotatedData
from netspec.dialects._boxes import (
    CENTER_SIZE,
    Array,
    as_array,
    check_predictions,
    decode,
    highest,
    onnx_decode,
    suppress,
)
from netspec.dialects._evaluate import DetectionEvaluate
from netspec.dialects._multibox import MultiBoxLoss
from netspec.layers import Layer, register
from netspec.layers.base import Shape, rounded
from netspec.layers.exporting import refusal
from netspec.layers.targets import OnnxGraph, TorchCode
from netspec.proto.schema import value
from netspec.terminal import log

DECLARATIONS = """
message PermuteParameter {
  repeated uint32 order = 1;
}
message NormalizeParameter {
  optional bool across_spatial = 1 [default = true];
  optional FillerParameter scale_filler = 2;
  optional bool channel_shared = 3 [default = true];
  optional float eps = 4 [default = 1e-10];
}
message PriorBoxParameter {
  enum CodeType { CORNER = 1; CENTER_SIZE = 2; CORNER_SIZE = 3; }
  repeated float min_size = 1;
  repeated float max_size = 2;
  repeated float aspect_ratio = 3;
  optional bool flip = 4 [default = true];
  optional bool clip = 5 [default = false];
  repeated float variance = 6;
  optional uint32 img_size = 7;
  optional uint32 img_h = 8;
  optional uint32 img_w = 9;
  optional float step = 10;
  optional float step_h = 11;
  optional float step_w = 12;
  optional float offset = 13 [default = 0.5];
}
message NonMaximumSuppressionParameter {
  optional float nms_threshold = 1 [default = 0.3];
  optional int32 top_k = 2;
  optional float eta = 3 [default = 1.0];
}
message ResizeParameter {
  enum Resize_mode { WARP = 1; FIT_SMALL_SIZE = 2; FIT_LARGE_SIZE_AND_PAD = 3; }
  enum Pad_mode { CONSTANT = 1; MIRRORED = 2; REPEAT_NEAREST = 3; }
  enum Interp_mode { LINEAR = 1; AREA = 2; NEAREST = 3; CUBIC = 4; LANCZOS4 = 5; }
  optional float prob = 1 [default = 1];
  optional Resize_mode resize_mode = 2 [default = WARP];
  optional uint32 height = 3 [default = 0];
  optional uint32 width = 4 [default = 0];
  optional Pad_mode pad_mode = 5 [default = CONSTANT];
  repeated float pad_value = 6;
  repeated Interp_mode interp_mode = 7;
  optional uint32 height_scale = 8 [default = 0];
  optional uint32 width_scale = 9 [default = 0];
}
message SaveOutputParameter {
  optional string output_directory = 1;
  optional string output_name_prefix = 2;
  optional string output_format = 3;
  optional string label_map_file = 4;
  optional string name_size_file = 5;
  optional uint32 num_test_image = 6;
  optional ResizeParameter resize_param = 7;
}
message DetectionOutputParameter {
  optional uint32 num_classes = 1;
  optional bool share_location = 2 [default = true];
  optional int32 background_label_id = 3 [default = 0];
  optional NonMaximumSuppressionParameter nms_param = 4;
  optional SaveOutputParameter save_output_param = 5;
  optional PriorBoxParameter.CodeType code_type = 6 [default = CORNER];
  optional int32 keep_top_k = 7 [default = -1];
  optional bool variance_encoded_in_target = 8 [default = false];
  optional float confidence_threshold = 9;
  optional bool visualize = 10 [default = false];
  optional float visualize_threshold = 11;
  optional string save_file = 12;
  optional float objectness_score = 13 [default = 0.01];
}
message MultiBoxLossParameter {
  enum LocLossType { L2 = 0; SMOOTH_L1 = 1; }
  enum ConfLossType { SOFTMAX = 0; LOGISTIC = 1; }
  enum MatchType { BIPARTITE = 0; PER_PREDICTION = 1; }
  enum MiningType { NONE = 0; MAX_NEGATIVE = 1; HARD_EXAMPLE = 2; }
  optional LocLossType loc_loss_type = 1 [default = SMOOTH_L1];
  optional ConfLossType conf_loss_type = 2 [default = SOFTMAX];
  optional float loc_weight = 3 [default = 1.0];
  optional uint32 num_classes = 4;
  optional bool share_location = 5 [default = true];
  optional MatchType match_type = 6 [default = PER_PREDICTION];
  optional float overlap_threshold = 7 [default = 0.5];
  optional bool use_prior_for_matching = 8 [default = true];
  optional uint32 background_label_id = 9 [default = 0];
  optional bool use_difficult_gt = 10 [default = true];
  optional bool do_neg_mining = 11;
  optional float neg_pos_ratio = 12 [default = 3.0];
  optional float neg_overlap = 13 [default = 0.5];
  optional PriorBoxParameter.CodeType code_type = 14 [default = CORNER];
  optional bool encode_variance_in_target = 16 [default = false];
  optional bool map_object_to_agnostic = 17 [default = false];
  optional bool ignore_cross_boundary_bbox = 18 [default = false];
  optional bool bp_inside = 19 [default = false];
  optional MiningType mining_type = 20 [default = MAX_NEGATIVE];
  optional NonMaximumSuppressionParameter nms_param = 21;
  optional int32 sample_size = 22 [default = 64];
  optional bool use_prior_for_nms = 23 [default = false];
}
message LabelMapItem {
  optional string name = 1;
  optional int32 label = 2;
  optional string display_name = 3;
}
message LabelMap {
  repeated LabelMapItem item = 1;
}
message NormalizedBBox {
  optional float xmin = 1;
  optional float ymin = 2;
  optional float xmax = 3;
  optional float ymax = 4;
  optional int32 label = 5;
  optional bool difficult = 6;
  optional float score = 7;
  optional float size = 8;
}
message Annotation {
  optional int32 instance_id = 1 [default = 0];
  optional NormalizedBBox bbox = 2;
}
message AnnotationGroup {
  optional int32 group_label = 1;
  repeated Annotation annotation = 2;
}
message AnnotatedDatum {
  enum AnnotationType { BBOX = 0; }
  optional Datum datum = 1;
  optional AnnotationType type = 2;
  repeated AnnotationGroup annotation_group = 3;
}
message Sampler {
  optional float min_scale = 1 [default = 1];
  optional float max_scale = 2 [default = 1];
  optional float min_aspect_ratio = 3 [default = 1];
  optional float max_aspect_ratio = 4 [default = 1];
}
message SampleConstraint {
  optional float min_jaccard_overlap = 1;
  optional float max_jaccard_overlap = 2;
  optional float min_sample_coverage = 3;
  optional float max_sample_coverage = 4;
  optional float min_object_coverage = 5;
  optional float max_object_coverage = 6;
}
message BatchSampler {
  optional bool use_original_image = 1 [default = true];
  optional Sampler sampler = 2;
  optional SampleConstraint sample_constraint = 3;
  optional uint32 max_sample = 4;
  optional uint32 max_trials = 5 [default = 100];
}
message AnnotatedDataParameter {
  repeated BatchSampler batch_sampler = 1;
  optional string label_map_file = 2;
  optional AnnotatedDatum.AnnotationType anno_type = 3;
}
message DetectionEvaluateParameter {
  optional uint32 num_classes = 1;
  optional uint32 background_label_id = 2 [default = 0];
  optional float overlap_threshold = 3 [default = 0.5];
  optional bool evaluate_difficult_gt = 4 [default = true];
  optional string name_size_file = 5;
  optional ResizeParameter resize_param = 6;
}
message DistortionParameter {
  optional float brightness_prob = 1 [default = 0];
  optional float brightness_delta = 2 [default = 0];
  optional float contrast_prob = 3 [default = 0];
  optional float contrast_lower = 4 [default = 0];
  optional float contrast_upper = 5 [default = 0];
  optional float hue_prob = 6 [default = 0];
  optional float hue_delta = 7 [default = 0];
  optional float saturation_prob = 8 [default = 0];
  optional float saturation_lower = 9 [default = 0];
  optional float saturation_upper = 10 [default = 0];
  optional float random_order_prob = 11 [default = 0];
}
message ExpansionParameter {
  optional float prob = 1 [default = 1];
  optional float max_expand_ratio = 2 [default = 1];
}
message EmitConstraint {
  enum EmitType { CENTER = 0; MIN_OVERLAP = 1; }
  optional EmitType emit_type = 1 [default = CENTER];
  optional float emit_overlap = 2;
}
extend TransformationParameter {
  optional ResizeParameter resize_param = 8;
  optional EmitConstraint emit_constraint = 10;
  optional uint32 crop_h = 11 [default = 0];
  optional uint32 crop_w = 12 [default = 0];
  optional DistortionParameter distort_param = 13;
  optional ExpansionParameter expand_param = 14;
}
extend SolverParameter {
  optional string eval_type = 43 [default = "classification"];
  optional bool show_per_class_result = 44 [default = false];
  optional string ap_version = 45 [default = "Integral"];
}
extend LayerParameter {
  optional AnnotatedDataParameter annotated_data_param = 200;
  optional MultiBoxLossParameter multibox_loss_param = 201;
  optional PermuteParameter permute_param = 202;
  optional PriorBoxParameter prior_box_param = 203;
  optional DetectionOutputParameter detection_output_param = 204;
  optional DetectionEvaluateParameter detection_evaluate_param = 205;
  optional NormalizeParameter norm_param = 206;
}
"""

register("MultiBoxLoss", "multibox_loss_param", "loss_param")(MultiBoxLoss)
register(
    "AnnotatedData",
    "annotated_data_param",
    "data_param",
    "transform_param",
    "transform_param.resize_param",
    "transform_param.emit_constraint",
    "transform_param.crop_h",
    "transform_param.crop_w",
    "transform_param.distort_param",
    "transform_param.expand_param",
)(AnnotatedData)
register("DetectionEvaluate", "detection_evaluate_param")(DetectionEvaluate)


@register("Permute", "permute_param")
class Permute(Layer):
    """Bring the axes into another order: axis i of the top is axis ``order``[i] of the bottom; the others follow.

    bottom[0]  any shape
    top[0]     its axes in the new order
    Fork: src/caffe/layers/permute_layer.cpp
    """

    @override
    def setup(self) -> None:
        given = list(value(self.param, "permute_param").order)
        axes = len(self.bottom_shapes[0])
        for i, axis in enumerate(given):
            if axis >= axes or axis in given[:i]:
                message = f"found axis {axis}, expected each of 0 to {axes - 1} at most once"
                raise self.error(message, "permute_param", "order", i)
        self.order = given + [axis for axis in range(axes) if axis not in given]

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if len(bottom_shapes[0]) != len(self.order):
            message = f"found a bottom of shape {bottom_shapes[0]}, expected {len(self.order)} axes as before"
            raise self.error(message, "bottom")
        return [tuple(bottom_shapes[0][axis] for axis in self.order)]

    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data.permute(self.order).contiguous()

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Transpose", *bottoms, perm=self.order)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.call(f"{{x}}.permute({', '.join(map(str, self.order))})", x=bottoms[0])


class _Normalized(torch.autograd.Function):
    """Normalize's formula. Its gradient is the fork's, not the derivative: the sum leaves the scales out.

    dx = scale / length (dy - x sum(x dy) / length^2), where the derivative has sum(scale x dy). With one scale for all
    channels the two are the same up to the place of the scale. Every SSD300 was trained with it.
    Fork: src/caffe/layers/normalize_layer.cpp, Backward_cpu
    """

    @staticmethod
    @override
    def forward(ctx: Any, x: torch.Tensor, scale: torch.Tensor, axes: tuple[int, ...], eps: float) -> torch.Tensor:
        length = (x.square().sum(axes, keepdim=True) + eps).sqrt()
        ctx.save_for_backward(x, scale, length)
        ctx.axes = axes
        return x / length * scale

    @staticmethod
    @override
    def backward(ctx: Any, dy: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, scale, length = ctx.saved_tensors
        share = (x * dy).sum(ctx.axes, keepdim=True) / length.square()
        dx = (dy - x * share) / length * scale if ctx.needs_input_grad[0] else None
        dscale = (x / length * dy).sum_to_size(scale.shape) if ctx.needs_input_grad[1] else None
        return dx, dscale, None, None


@register("Normalize", "norm_param")
class Normalize(Layer):
    """Divide by the length over the channels, or with across_spatial over the whole image; multiply by learned scales.

    y = scale x / sqrt(sum of squares + eps)

    bottom[0]  (N, C, ...)
    top[0]     the same shape
    blobs[0]   scales (), or (C,) where channel_shared is false; 1 unless scale_filler is given
    Fork: src/caffe/layers/normalize_layer.cpp
    """

    @override
    def setup(self) -> None:
        param, shape = value(self.param, "norm_param"), self.bottom_shapes[0]
        if len(shape) < 2:
            raise self.error(f"found a bottom of shape {shape}, expected at least 2 axes (N, C, ...)", "bottom")
        filler = param.scale_filler if param.HasField("scale_filler") else None
        self.add_blob(() if param.channel_shared else shape[1:2], filler, value=1.0)

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the bottom's shape; there must be a scale for each channel."""
        shape = bottom_shapes[0]
        if len(shape) < 2 or self.blob_shapes[0] not in ((), shape[1:2]):
            raise self.error(f"bottom of shape {shape} does not have the {self.blob_shapes[0][0]} channels", "bottom")
        return [shape]

    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
        param = value(self.param, "norm_param")
        axes = tuple(range(1, data.dim())) if param.across_spatial else (1,)
        scale = self.blob(0)
        scale = scale if scale.dim() == 0 else scale.reshape(-1, *(1,) * (data.dim() - 2))
        return _Normalized.apply(data, scale, axes, param.eps)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        param, axes = value(self.param, "norm_param"), len(self.bottom_shapes[0])
        over = graph.constant(list(range(1, axes)) if param.across_spatial else [1])
        squares = graph.node("ReduceSum", graph.node("Mul", *bottoms, *bottoms), over, keepdims=1)
        length = graph.node("Sqrt", graph.node("Add", squares, graph.constant(param.eps)))
        shape = (*self.blob_shapes[0], *(1,) * (axes - 2)) if self.blob_shapes[0] else ()
        return graph.node("Mul", graph.node("Div", *bottoms, length), graph.blob(0, shape))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        param, axes = value(self.param, "norm_param"), len(self.bottom_shapes[0])
        over = tuple(range(1, axes)) if param.across_spatial else 1
        shape = (*self.blob_shapes[0], *(1,) * (axes - 2)) if self.blob_shapes[0] else ()
        template = f"{code.function(normalize)}({{x}}, {{scale}}, {{over}}, eps={{eps}})"
        return code.call(template, scale=code.parameter(0, shape), x=bottoms[0], over=over, eps=rounded(param.eps))


@register("PriorBox", "prior_box_param")
class PriorBox(Layer):
    """Lay boxes of some sizes and aspect ratios around the center of every pixel of a map.

    For each min_size: a square of it; with max_sizes a square of sqrt(min_size max_size); then for each aspect_ratio
    r, and 1 / r with ``flip``, min_size sqrt(r) by min_size / sqrt(r). Sizes are cut to whole pixels. Centers are at
    (index + offset) step; where they are not given, the step is image / map and the image is bottom[1].

    bottom[0]  the map (N, C, H, W)
    bottom[1]  the image (N, C', H', W'); not needed where img_size, or img_h and img_w, are given
    top[0]     (1, 2, 4 H W K), K boxes a pixel: [0, 0] (xmin, ymin, xmax, ymax) in parts of the image, [0, 1] variances
    Fork: src/caffe/layers/prior_box_layer.cpp
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({0, 1})

    @override
    def setup(self) -> None:
        param = value(self.param, "prior_box_param")
        if not param.min_size or min(param.min_size) < 1:
            raise self.error("min_size must be given and be at least 1", "prior_box_param", "min_size")
        if param.max_size and len(param.max_size) != len(param.min_size):
            message = f"found {len(param.max_size)} max_size, expected none or {len(param.min_size)}, one per min_size"
            raise self.error(message, "prior_box_param", "max_size")
        for i, (small, large) in enumerate(zip(param.min_size, param.max_size, strict=False)):
            if large <= small:
                message = f"max_size {large:g} must be greater than its min_size {small:g}"
                raise self.error(message, "prior_box_param", "max_size", i)
        if len(param.variance) not in (0, 1, 4) or any(v <= 0 for v in param.variance):
            raise self.error("variance must be one number or four, each above 0", "prior_box_param", "variance")
        self.variances = np.array(list(param.variance) or [0.1], np.float32) * np.ones(4, np.float32)
        self.sizes = self._sizes(param)
        self._warn_of_cut_sizes(param)
        self.image = self._pair(param, "img_size", "img_h", "img_w")
        self.step = self._pair(param, "step", "step_h", "step_w")
        if self.image is None and len(self.bottom_shapes) < 2:
            message = "the image is missing: give it as a second bottom, or img_size, or img_h and img_w"
            raise self.error(message, "bottom")

    def _sizes(self, param: Any) -> Array:
        """Return width and height of the boxes of one pixel (K, 2)."""
        ratios = [1.0]
        for ratio in param.aspect_ratio:
            if ratio <= 0:
                raise self.error(f"aspect_ratio must be above 0, found {ratio:g}", "prior_box_param", "aspect_ratio")
            if all(abs(ratio - known) >= 1e-6 for known in ratios):
                ratios += [ratio, 1 / ratio] if param.flip else [ratio]
        sizes = []
        for i, small in enumerate(map(self.pixels, param.min_size)):
            sizes.append((small, small))
            if param.max_size:
                sizes.append((math.sqrt(small * self.pixels(param.max_size[i])),) * 2)
            sizes += [(small * math.sqrt(ratio), small / math.sqrt(ratio)) for ratio in ratios[1:]]
        return np.array(sizes, np.float32)

    def _warn_of_cut_sizes(self, param: Any) -> None:
        """Say which sizes are cut: other forks and OpenCV keep them, and nets trained there find other boxes here."""
        for name in ("min_size", "max_size"):
            sizes = getattr(param, name)
            cut = [f"{rounded(size):g} to {self.pixels(size):g}" for size in sizes if self.pixels(size) != size]
            if cut:
                place = self.context.at("prior_box_param", name, 0)
                found = f"{place}: {name} is cut to whole pixels, as in SSD: {', '.join(cut)}"
                log.logger.warning(f"{found}; OpenCV and some forks keep it, so a net trained there gives other boxes")

    def pixels(self, size: float) -> float:
        """Return the size that a box gets for a given ``min_size`` or ``max_size``."""
        return int(size)

    def _pair(self, param: Any, both: str, height: str, width: str) -> tuple[float, float] | None:
        """Return (vertical, horizontal) of a setting given as one number or as two; None where it is not given."""
        given = [name for name in (both, height, width) if param.HasField(name)]
        if not given:
            return None
        if given not in ([both], [height, width]) or any(getattr(param, name) <= 0 for name in given):
            message = f"expected {both}, or both {height} and {width}, above 0; found {' and '.join(given)}"
            raise self.error(message, "prior_box_param", given[0])
        return getattr(param, given[0]), getattr(param, given[-1])

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the boxes; lay them."""
        if any(len(shape) != 4 for shape in bottom_shapes):
            raise self.error(f"found bottoms of shapes {bottom_shapes}, expected 4 axes (N, C, H, W)", "bottom")
        height, width = bottom_shapes[0][2:]
        image = self.image or bottom_shapes[1][2:]
        step = self.step or (image[0] / height, image[1] / width)
        param = value(self.param, "prior_box_param")
        offset = np.float32(param.offset)
        y = (np.arange(height, dtype=np.float32) + offset) * np.float32(step[0])
        x = (np.arange(width, dtype=np.float32) + offset) * np.float32(step[1])
        centre = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)[:, :, None].astype(float)
        half = self.sizes / 2.0
        extent = np.array(image[::-1], float)
        boxes = np.concatenate([(centre - half) / extent, (centre + half) / extent], axis=-1).astype(np.float32)
        boxes = boxes.clip(0, 1) if param.clip else boxes
        self.boxes = np.stack([boxes.reshape(-1), np.tile(self.variances, boxes.size // 4)])[None]
        return [self.boxes.shape]

    @override
    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(self.boxes).to(bottoms[0])

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        image_is_free = self.image is None and None in graph.sizes(1)[2:]
        if None not in graph.sizes(0)[2:] and not image_is_free:
            return graph.node("Identity", graph.constant(self.boxes))
        sides = []
        for k in (0, 1):  # vertical, horizontal
            count = graph.shape_of(bottoms[0], 2 + k, 3 + k)
            if self.image:
                extent = graph.constant([float(self.image[k])])
            else:
                extent = graph.cast(graph.shape_of(bottoms[1], 2 + k, 3 + k), "float32")
            if self.step:
                step = graph.constant([float(self.step[k])])
            else:
                step = graph.node("Div", extent, graph.cast(count, "float32"))
            zero, one = graph.constant(0), graph.constant(1)
            index = graph.cast(graph.node("Range", zero, graph.node("Squeeze", count), one), "float32")
            offset = graph.constant(value(self.param, "prior_box_param").offset)
            center = graph.node("Mul", graph.node("Add", index, offset), step)
            center = graph.reshape(center, [-1, 1, 1] if k == 0 else [1, -1, 1])
            half = graph.constant(self.sizes[:, 1 - k] / np.float32(2))
            sides.append([graph.node("Div", graph.node(op, center, half), extent) for op in ("Sub", "Add")])
        (top, bottom), (left, right) = sides
        down, across = graph.shape_of(bottoms[0], 2, 3), graph.shape_of(bottoms[0], 3, 4)
        shape = graph.node("Concat", down, across, graph.constant([len(self.sizes)]), axis=0)
        last = graph.constant([3])
        corners = [
            graph.node("Unsqueeze", graph.node("Expand", side, shape), last) for side in (left, top, right, bottom)
        ]
        boxes = graph.node("Concat", *corners, axis=3)
        if value(self.param, "prior_box_param").clip:
            boxes = graph.node("Clip", boxes, graph.constant(0.0), graph.constant(1.0))
        variances = graph.node("Expand", graph.constant(self.variances), graph.shape_of(boxes))
        return graph.node("Concat", *(graph.reshape(part, [1, 1, -1]) for part in (boxes, variances)), axis=1)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        param = value(self.param, "prior_box_param")
        image = code.call("{image}", image=self.image) if self.image else code.call("{y}.shape[2:]", y=bottoms[1])
        sizes = [(rounded(float(width)), rounded(float(height))) for width, height in self.sizes]
        options = {
            "sizes": sizes,
            "variances": tuple(rounded(float(v)) for v in self.variances),
            **({"step": self.step} if self.step else {}),
            **({"offset": rounded(param.offset)} if param.offset != 0.5 else {}),
            **({"clip": True} if param.clip else {}),
        }
        given = ", ".join(f"{name}={{{name}}}" for name in options)
        template = f"{code.function(prior_boxes)}({{x}}, {{image}}, {given})"
        return code.call(template, x=bottoms[0], image=image, **options)


@register("DetectionOutput", "detection_output_param")
class DetectionOutput(Layer):
    """Decode the predicted boxes, and of each class keep those of high confidence that overlap none of a higher one.

    With five bottoms it is RefineDet's: the priors are refined first, and those that show no object with a confidence
    of ``objectness_score`` are left out.

    bottom[0]  predicted boxes (N, 4 P) for P priors; (N, 4 P num_classes) where share_location is false
    bottom[1]  confidences (N, P num_classes)
    bottom[2]  priors and variances (1, 2, 4 P)
    bottom[3]  optional, not used: the images, which the fork draws the boxes into; RefineDet's: confidences (N, 2 P) of
               no object and of one
    bottom[4]  RefineDet's: the boxes (N, 4 P) that the priors are refined by
    top[0]     (1, 1, D, 7): image, label, confidence, xmin, ymin, xmax, ymax of D detections; D is 1 before the first
               pass. Where nothing is found, a row (image, -1, -1, ...) for each image. Brings no gradient.
    Fork: src/caffe/layers/detection_output_layer.cpp, also of sfzhang15/RefineDet
    """

    bottoms = (3, 5)
    counted_axis = 2
    label_bottoms = frozenset(range(5))
    ignores = frozenset(
        f"detection_output_param.{name}"
        for name in ("save_output_param", "visualize", "visualize_threshold", "save_file")
    )

    @override
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

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of one detection; the predictions must suit the priors."""
        param = value(self.param, "detection_output_param")
        self.priors = check_predictions(self, bottom_shapes, self.kinds, param.num_classes)
        for i, each in ((3, 2), (4, 4)) if len(bottom_shapes) == 5 else ():
            if math.prod(bottom_shapes[i]) != bottom_shapes[0][0] * self.priors * each:
                message = f"found a bottom of shape {bottom_shapes[i]}, expected ({bottom_shapes[0][0]}, {each} P)"
                raise self.error(f"{message} for {self.priors} priors", "bottom", i)
        return [(1, 1, 1, 7)]

    @override
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
        found = np.concatenate(rows)
        if not len(found):
            found = np.full((len(codes), 7), -1, np.float32)
            found[:, 0] = np.arange(len(codes))
        return torch.from_numpy(found[None, None]).to(loc)

    def _detect(self, image: int, boxes: list[Array], scores: Array) -> Array:
        """Return the detections of one image, by label, the most confident first: (d, 7)."""
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

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        param = value(self.param, "detection_output_param")
        nms = param.nms_param
        if nms.eta < 1:
            raise refusal(self, "ONNX", "its non-maximum suppression has a fixed threshold: eta must be 1")
        if len(bottoms) == 5:
            raise refusal(self, "ONNX", "its priors are refined")
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
        # One more row that is not a detection, so that there is always one: OpenCV 5.0 dies of empty tensors.
        found = graph.node("Concat", found, graph.constant([[0, 0, 0]]), axis=0)
        if param.keep_top_k > -1:
            found = self._onnx_best(graph, bottoms[0], scores, found, param.keep_top_k)
        return self._onnx_rows(graph, bottoms[0], boxes, scores, found, classes)

    def _onnx_boxes_and_scores(
        self, graph: OnnxGraph, bottoms: Sequence[str], classes: Sequence[int]
    ) -> tuple[str, str]:
        """Write boxes (N, P, 4) and scores (N, classes, P); where each class has boxes of its own (N classes, 1, P)."""
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
        """Write which of the detections (D + 1, 3) are among the ``most`` confident of their image, in their order.

        The last row stays whatever it is.
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
        """Write the top: a row for each detection (item, class, box) but the last; without any, one for each image."""
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
        param = value(self.param, "detection_output_param")
        nms = param.nms_param
        if nms.eta < 1:
            raise refusal(self, "PyTorch", "its non-maximum suppression has a fixed threshold: eta must be 1")
        if len(bottoms) == 5:
            raise refusal(self, "PyTorch", "its priors are refined")
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


# Copied into exported PyTorch modules


def normalize(x, scale, axes, eps):
    """Divide by the length over some axes, and multiply by learned scales."""
    length = (x.square().sum(axes, keepdim=True) + eps).sqrt()
    return scale * x / length


def prior_boxes(x, image, sizes, variances, step=None, offset=0.5, clip=False):
    """Return boxes of some sizes (width, height) around the center of every pixel of x, in parts of the image.

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
    loc,
    conf,
    prior,
    classes,
    background,
    overlap,
    confidence=-torch.inf,
    candidates=None,
    most=None,
    encoded=False,
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
