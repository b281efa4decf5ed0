"""SSD, the single shot detector: weiliu89/caffe, branch ssd.

The databases for its layer AnnotatedData are written by the fork's convert_annoset, as records of AnnotatedDatum.
"""

from __future__ import annotations

from netspec.dialects.blocks.normalize import Normalize
from netspec.dialects.blocks.order import Reordered
from netspec.dialects.layers import replace
from netspec.dialects.ssd import faceboxes
from netspec.dialects.ssd.annotated import AnnotatedData
from netspec.dialects.ssd.detection import DetectionOutput
from netspec.dialects.ssd.evaluate import DetectionEvaluate
from netspec.dialects.ssd.multibox import MultiBoxLoss
from netspec.dialects.ssd.priors import PriorBox
from netspec.layers import register
from netspec.proto.schema import value

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
  // TextBoxes++
  optional bool denser_prior_boxes = 14 [default = false];
  // FaceBoxes
  repeated float fixed_size = 24;
  repeated float fixed_ratio = 25;
  repeated uint32 density = 26;
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
  // eric612/MobileNet-YOLO
  optional int32 yolo_data_type = 4 [default = 0];
  optional float yolo_data_jitter = 5 [default = 0.3];
  optional bool train_diffcult = 6 [default = true];
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
  repeated ResizeParameter resize_param = 8;
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
register("PriorBox", "prior_box_param")(PriorBox)
replace("PriorBox", "prior_box_param", where=faceboxes.is_fixed)(faceboxes.PriorBox)
register("DetectionOutput", "detection_output_param")(DetectionOutput)
register("Normalize", "norm_param", "normalize_param")(Normalize)


@register("Permute", "permute_param")
class Permute(Reordered):
    """Permute the axes: axis i of the top is axis ``order``[i] of the bottom; the others follow.

    bottom[0]  any shape
    top[0]     its axes in the new order
    Fork: src/caffe/layers/permute_layer.cpp
    """

    def setup(self) -> None:
        given = list(value(self.param, "permute_param").order)
        axes = len(self.bottom_shapes[0])
        for i, axis in enumerate(given):
            if axis >= axes or axis in given[:i]:
                message = f"found axis {axis}, expected each of 0 to {axes - 1} at most once"
                raise self.error(message, "permute_param", "order", i)
        self.perm = given + [axis for axis in range(axes) if axis not in given]
