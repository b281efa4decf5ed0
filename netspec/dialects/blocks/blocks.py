"""Building blocks of many forks for classification and segmentation: SENet, PSPNet, SegNet, MobileNet, ...

If two forks have different layers with the same type (BN, Upsample), the given fields determine which is meant.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F

from netspec.dialects.blocks.relu6 import Capped
from netspec.dialects.segmentation.segnet import BN, Upsample
from netspec.layers import Layer, register
from netspec.layers.contract.base import Shape
from netspec.layers.vision.convolution import Convolution
from netspec.proto.schema import value

DECLARATIONS = """
message InterpParameter {
  optional int32 height = 1 [default = 0];
  optional int32 width = 2 [default = 0];
  optional int32 zoom_factor = 3 [default = 1];
  optional int32 shrink_factor = 4 [default = 1];
  optional int32 pad_beg = 5 [default = 0];
  optional int32 pad_end = 6 [default = 0];
}
message BNParameter {
  enum Engine { DEFAULT = 0; CAFFE = 1; CUDNN = 2; }
  enum BNMode { LEARN = 0; INFERENCE = 1; }
  // PSPNet
  optional FillerParameter slope_filler = 1;
  optional FillerParameter bias_filler = 2;
  optional float momentum = 3 [default = 0.9];
  optional float eps = 4 [default = 1e-5];
  optional bool frozen = 5 [default = false];
  optional Engine engine = 6 [default = DEFAULT];
  // SegNet
  optional FillerParameter scale_filler = 11;
  optional FillerParameter shift_filler = 12;
  optional BNMode bn_mode = 13 [default = LEARN];
}
message UpsampleParameter {
  optional uint32 scale = 1;
  optional uint32 scale_h = 2;
  optional uint32 scale_w = 3;
  optional bool pad_out_h = 4 [default = false];
  optional bool pad_out_w = 5 [default = false];
  optional uint32 upsample_h = 6;
  optional uint32 upsample_w = 7;
}
message DeephiResizeParameter {
  enum ResizeType { BILINEAR = 0; NEAREST = 1; }
  optional uint32 new_height = 1;
  optional uint32 new_width = 2;
  optional float scale_h = 3;
  optional float scale_w = 4;
  optional ResizeType resize_type = 5 [default = BILINEAR];
}
message ReLU6Parameter {
  optional float negative_slope = 1 [default = 0];
}
message ShuffleChannelParameter {
  optional uint32 group = 1 [default = 1];
}
message SegAccuracyParameter {
  enum AccuracyMetric { PixelAccuracy = 0; ClassAccuracy = 1; PixelIOU = 2; }
  optional AccuracyMetric metric = 1 [default = PixelAccuracy];
  repeated int32 ignore_label = 2;
  optional bool reset = 3 [default = true];
}
extend LayerParameter {
  optional UpsampleParameter upsample_param = 160;
  optional InterpParameter interp_param = 163;
  optional ShuffleChannelParameter shuffle_channel_param = 164;
  optional BNParameter bn_param = 1137;
  optional SegAccuracyParameter seg_accuracy_param = 1138;
  optional DeephiResizeParameter deephi_resize_param = 1139;
  optional ReLU6Parameter relu6_param = 100000;
}
// DeepLab's files have the format before "layer"
enum OldTypes { INTERP = 1; SEG_ACCURACY = 2; }
extend V1LayerParameter {
  optional OldTypes type = 2000;
  optional InterpParameter interp_param = 2001;
  optional SegAccuracyParameter seg_accuracy_param = 2002;
}
"""


@register("Axpy")
class Axpy(Layer):
    """Compute a x + y with one factor a per channel of each image, as at the end of a squeeze-and-excitation block.

    bottom[0]  a (N, C) or (N, C, 1, 1)
    bottom[1]  x (N, C, ...)
    bottom[2]  y, the shape of x
    top[0]     the shape of x
    Fork: hujie-frank/SENet, src/caffe/layers/axpy_layer.cpp
    """

    bottoms = (3, 3)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        a, x, y = bottom_shapes
        if len(a) < 2 or a[:2] != x[:2] or any(size != 1 for size in a[2:]) or x != y:
            message = f"found shapes {a}, {x} and {y}, expected (N, C, 1, 1) and twice (N, C, ...)"
            raise self.error(message, "bottom")
        return [x]

    def forward(self, a: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return torch.addcmul(y, a.reshape(*a.shape[:2], *(1,) * (x.dim() - 2)), x)


@register("ReLU6", "relu6_param")
class ReLU6(Capped):
    """min(max(x, 0) + negative_slope min(x, 0), 6). The gradient at 0 is that of the negative side; at 6 it is 0.

    bottom[0]  any shape
    top[0]     the same shape
    Fork: chuanqi305/ssd and others, src/caffe/layers/relu6_layer.cpp
    """

    def setup(self) -> None:
        self.slope: float = value(self.param, "relu6_param").negative_slope


@register("DepthwiseConvolution", "convolution_param")
class DepthwiseConvolution(Convolution):
    """A separate convolution of each channel; if group is given, it must be the number of channels.

    bottom[i]  (N, C, H, W)
    top[i]     (N, num_output, H', W') as Convolution's
    blobs[0]   filters (num_output, 1, kernel_h, kernel_w)
    blobs[1]   bias    (num_output,)                                   unless bias_term: false
    Fork: yonghenglh6/DepthwiseConvolution
    """

    def setup(self) -> None:
        """Set up like Convolution; raise SpecError for filters over more than one channel."""
        if not self.param.convolution_param.HasField("group"):
            self.param = copy.deepcopy(self.param)
            self.param.convolution_param.group = self.bottom_shapes[0][1] if len(self.bottom_shapes[0]) > 1 else 1
        super().setup()
        if self.group != self.channels:
            message = f"group must be the number of channels, {self.channels}, found {self.group}"
            raise self.error(message, "convolution_param", "group")


@register("ConvolutionDepthwise", "convolution_param")
class ConvolutionDepthwise(Convolution):
    """A separate convolution of each channel; num_output and group are not needed and not read.

    bottom[0]  (N, C, H, W)
    top[0]     (N, C, H', W') as Convolution's
    blobs[0]   filters (C, 1, kernel_h, kernel_w)
    blobs[1]   bias    (C,)                                            unless bias_term: false
    Fork: BVLC/caffe#5665, farmingyard/ShuffleNet, src/caffe/layers/conv_dw_layer.cpp
    """

    bottoms = (1, 1)
    tops = (1, 1)
    ignores = frozenset({"convolution_param.group"})

    def setup(self) -> None:
        self.read_geometry()
        if self.spatial_axes != 2 or not self.bottom_shapes[0][self.channel_axis]:
            raise self.error(f"found a bottom of shape {self.bottom_shapes[0]}, expected (N, C, H, W)", "bottom")
        param = self.param.convolution_param
        self.channels = self.num_output = self.group = self.bottom_shapes[0][self.channel_axis]
        if param.num_output != self.channels:
            self.ignores = self.ignores | {"convolution_param.num_output"}
        self.add_blob(self.filter_shape(), param.weight_filler)
        if param.bias_term:
            self.add_blob((self.num_output,), param.bias_filler)


@register("ShuffleChannel", "shuffle_channel_param")
class ShuffleChannel(Layer):
    """Interleave the channels of ``group`` groups: the first channel of each group, then the second of each, and so on.

    bottom[0]  (N, C, ...), C a multiple of group
    top[0]     the same shape
    Fork: farmingyard/ShuffleNet, shuffle_channel_layer.cpp
    """

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shape, self.group = bottom_shapes[0], value(self.param, "shuffle_channel_param").group
        if len(shape) < 2 or self.group < 1 or shape[1] % self.group:
            message = f"found a bottom of shape {shape}, expected channels that are a multiple of group, {self.group}"
            raise self.error(message, "shuffle_channel_param", "group")
        return [shape]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data.unflatten(1, (self.group, -1)).transpose(1, 2).flatten(1, 2)


@register("Interp", "interp_param")
class Interp(Layer):
    """Crop a border of each map, then resize it bilinearly with aligned corner pixels.

    The new size is height and width, or that of the second bottom, or is computed from shrink_factor s and zoom_factor
    z (if both are given, one after the other): (H - 1) // s + 1 and H + (H - 1) (z - 1).

    bottom[0]  (N, C, H, W)
    bottom[1]  optional: a blob of the new height and width; gets no gradient
    top[0]     (N, C, H', W')
    Fork: DeepLab, hszhao/PSPNet, src/caffe/layers/interp_layer.cpp, src/caffe/util/interp.cpp
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({1})

    def setup(self) -> None:
        param: Any = value(self.param, "interp_param")
        factors = [name for name in ("shrink_factor", "zoom_factor") if param.HasField(name)]
        explicit = [name for name in ("height", "width") if param.HasField(name)]
        ways = [bool(factors), bool(explicit), len(self.bottom_shapes) == 2]
        if sum(ways) != 1 or len(explicit) == 1:
            found = ", ".join([*factors, *explicit, *["a second bottom"][: ways[2]]]) or "none of them"
            message = f"expected zoom_factor or shrink_factor, or height and width, or a second bottom; found {found}"
            raise self.error(message, "interp_param")
        for name in factors + explicit:
            if getattr(param, name) < 1:
                raise self.error(f"{name} must be at least 1, found {getattr(param, name)}", "interp_param", name)
        for name in ("pad_beg", "pad_end"):
            if getattr(param, name) > 0:
                message = f"{name} must be 0, or negative to cut off pixels, found {getattr(param, name)}"
                raise self.error(message, "interp_param", name)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        param, shape = value(self.param, "interp_param"), bottom_shapes[0]
        if any(len(each) != 4 for each in bottom_shapes):
            raise self.error(f"found bottoms of shapes {bottom_shapes}, expected 4 axes (N, C, H, W)", "bottom")
        inner = [size + param.pad_beg + param.pad_end for size in shape[2:]]
        if min(inner) < 1:
            raise self.error(f"pad_beg and pad_end leave nothing of a map of {shape[2]} x {shape[3]}", "interp_param")
        if len(bottom_shapes) == 2:
            size = bottom_shapes[1][2:]
        elif param.HasField("height"):
            size = (param.height, param.width)
        else:
            shrunk = [(length - 1) // param.shrink_factor + 1 for length in inner]
            size = tuple(length + (length - 1) * (param.zoom_factor - 1) for length in shrunk)
        return [(*shape[:2], *size)]

    def forward(self, data: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
        param = value(self.param, "interp_param")
        cut = [param.pad_beg, param.pad_end] * 2
        inner = F.pad(data, cut) if any(cut) else data
        return F.interpolate(inner, self.top_shapes[0][2:], mode="bilinear", align_corners=True)


@register("DeephiResize", "deephi_resize_param")
class DeephiResize(Layer):
    """Resize each map like OpenCV, to new_height and new_width, or by scale_h and scale_w, rounded down.

    bottom[0]  (N, C, H, W)
    top[0]     (N, C, H', W')
    Fork: Xilinx' Caffe, src/caffe/layers/deephi_resize_layer.cpp, without its rounding for the DPU
    """

    def setup(self) -> None:
        self.settings = p = value(self.param, "deephi_resize_param")
        self.nearest = p.resize_type == p.NEAREST
        pairs = ("new_height", "new_width"), ("scale_h", "scale_w")
        if not any(all(0 < getattr(p, name) < math.inf for name in pair) for pair in pairs):
            raise self.error(
                "expected new_height and new_width, or scale_h and scale_w, above 0", "deephi_resize_param"
            )

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        p, (shape,) = self.settings, bottom_shapes
        size = p.new_height, p.new_width
        if not p.new_height and len(shape) == 4:
            size = int(shape[2] * p.scale_h), int(shape[3] * p.scale_w)
        if len(shape) != 4 or min(size) < 1:
            raise self.error(
                f"found a bottom of shape {shape} for a top of {size[0]} x {size[1]}, expected maps", "bottom"
            )
        return [(*shape[:2], *size)]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return F.interpolate(data, self.top_shapes[0][2:], mode="nearest" if self.nearest else "bilinear")


register("Upsample", "upsample_param")(Upsample)
register("BN", "bn_param")(BN)


@register("SegAccuracy", "seg_accuracy_param")
class SegAccuracy(Layer):
    """The accuracy of pixel classification, from a confusion matrix, which accumulates over passes with reset: false.

    If scores are equal, the last class counts. A class that neither occurs nor is predicted has intersection / union 1.

    bottom[0]  scores (N, C, H, W)
    bottom[1]  labels (N, 1, H, W); ignore_label is ignored
    top[0]     (1, 1, 1, 3): share of correct pixels, its mean over the classes that occur, and the mean of
               intersection / union over all classes
    Fork: hszhao/PSPNet, src/caffe/layers/seg_accuracy_layer.cpp
    """

    bottoms = (2, 2)
    label_bottoms = frozenset({0, 1})
    not_exported = "it is for tests"

    def setup(self) -> None:
        self.settings, self.counts_before = value(self.param, "seg_accuracy_param"), torch.zeros(0)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        scores, labels = bottom_shapes
        if len(scores) != 4 or labels != (scores[0], 1, *scores[2:]):
            message = f"found bottoms of shapes {scores} and {labels}, expected (N, C, H, W) and (N, 1, H, W)"
            raise self.error(message, "bottom", 1)
        return [(1, 1, 1, 3)]

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        classes, labels = scores.shape[1], labels[:, 0].long()
        counts = ~torch.isin(labels, torch.tensor(list(self.settings.ignore_label), device=labels.device))
        label, best = labels[counts], classes - 1 - scores.flip(1).argmax(1)[counts]
        if label.numel() and not 0 <= int(label.min()) <= int(label.max()) < classes:
            raise self.error(f"found a label outside 0 to {classes - 1}; write it as ignore_label", "bottom", 1)
        found = torch.bincount(label * classes + best, minlength=classes**2).view(classes, classes).double()
        found = found if self.settings.reset or not self.counts_before.numel() else found + self.counts_before
        self.counts_before = found
        right, there = found.diagonal(), found.sum(1)
        union = there + found.sum(0) - right
        recall = (right / there)[there > 0]
        shares = right.sum() / found.sum().clamp(min=1), recall.sum() / max(len(recall), 1)
        return torch.stack([*shares, torch.where(union > 0, right / union, 1.0).mean()]).to(scores).view(1, 1, 1, 3)
