"""happynear/caffe-windows, for face recognition: Normalize without a scale (blocks/normalize.py), losses, margins.

Its BN keeps 1 / std in blobs[3] (segmentation/segnet.py), as do wy1iu/LargeMargin_Softmax_Loss and Cysu/caffe, branch
domain-guided-dropout. If no field determines the fork, the dialect must be named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.dialects.faces.margins import MarginProduct
from netspec.dialects.gradients import with_gradient_of
from netspec.dialects.layers import replace
from netspec.dialects.not_learned import NotLearned
from netspec.layers import Layer, common, register
from netspec.layers.activation import Activation
from netspec.layers.contract.base import Shape, State
from netspec.layers.loss.base import VALID, Classified, Loss, ignore_label, normalization_mode, normalizer
from netspec.layers.loss.scores import FLT_MIN
from netspec.proto.schema import TEST, value

DECLARATIONS = """
message NormalizeLengthParameter {
  optional string normalize_type = 1 [default = "L2"];
  optional bool fix_gradient = 2 [default = false];
  optional bool bp_norm = 3 [default = false];
}
message FlipParameter {
  optional bool flip_width = 1 [default = true];
  optional bool flip_height = 2 [default = false];
}
message TripletLossParameter {
  optional float margin = 1 [default = 1.0];
}
message FocalLossParameter {
  enum Type { ORIGIN = 0; LINEAR = 1; ONEADDP = 2; }
  optional Type type = 1 [default = ORIGIN];
  optional float gamma = 2 [default = 2];
  optional float alpha = 3 [default = 1.0];
  optional float beta = 4 [default = 1.0];
}
message ChannelScaleParameter {
  optional bool do_forward = 1 [default = true];
  optional bool do_backward_feature = 2 [default = true];
  optional bool do_backward_scale = 3 [default = true];
  optional bool global_scale = 4 [default = false];
  optional float max_global_scale = 5 [default = 1000.0];
  optional float min_global_scale = 6 [default = 0.0];
  optional float init_global_scale = 7 [default = 1.0];
}
message LabelSpecificAddParameter {
  optional float bias = 1 [default = 0.0];
  optional bool transform_test = 2 [default = false];
  optional float bias_base = 3 [default = 0.0];
  optional float bias_gamma = 4 [default = 0.0];
  optional float bias_power = 5 [default = 1.0];
  optional float bias_min = 6 [default = 0.0];
  optional float bias_max = 7 [default = 0.0];
  optional uint32 iteration = 8 [default = 0];
}
message LargeMarginInnerProductParameter {
  optional uint32 num_output = 1;
  enum LargeMarginType { SINGLE = 0; DOUBLE = 1; TRIPLE = 2; QUADRUPLE = 3; }
  optional LargeMarginType type = 2 [default = SINGLE];
  optional FillerParameter weight_filler = 3;
  optional int32 axis = 4 [default = 1];
  optional float base = 5 [default = 1];
  optional float gamma = 6 [default = 0];
  optional float power = 7 [default = 1];
  optional int32 iteration = 8 [default = 0];
  optional float lambda_min = 9 [default = 0];
}
extend InnerProductParameter {
  optional bool normalize = 7 [default = false];
}
extend LayerParameter {
  optional NormalizeLengthParameter normalize_param = 1214;
  optional FlipParameter flip_param = 1232;
  optional TripletLossParameter triplet_loss_param = 1233;
  optional FocalLossParameter focal_loss_param = 1234;
  optional ChannelScaleParameter channel_scale_param = 1235;
  optional LabelSpecificAddParameter label_specific_add_param = 1236;
  optional LargeMarginInnerProductParameter largemargin_inner_product_param = 1237;
}
"""


@register("LargeMarginInnerProduct", "largemargin_inner_product_param")
class LargeMarginInnerProduct(MarginProduct):
    """L-Softmax: products, which at the label are (|x| |w| psi(angle) + lambda x w) / (1 + lambda).

    Fork: wy1iu/LargeMargin_Softmax_Loss, src/caffe/layers/largemargin_inner_product_layer.cpp
    """

    message = "largemargin_inner_product_param"

    @override
    def products(self, x: torch.Tensor, labels: torch.Tensor, share: float) -> torch.Tensor:
        weight = self.blob(0)
        top = x @ weight.t()
        if self.margin is None:
            return top
        plain = top.gather(1, labels[:, None])
        lengths = (x.norm(dim=1) * weight.norm(dim=1)[labels])[:, None] + 1e-9
        found = lengths * self.margin(plain / lengths)[0]
        return top.scatter_add(1, labels[:, None], share * (found - plain))


def normalizes(param: Any) -> bool:
    """Return whether a LayerParameter asks for weights of length 1."""
    return value(param.inner_product_param, "normalize")


@replace(
    "InnerProduct",
    "inner_product_param",
    "inner_product_param.normalize",
    where=normalizes,
)
class NormalizedInnerProduct(common.InnerProduct):
    """Products with weights that each pass normalizes to length 1, in each num_output-th part of the memory.

    The gradient ignores the normalization.
    Fork: happynear/caffe-windows, src/caffe/layers/inner_product_layer.cpp
    """

    not_exported = "its weights are for training; what is used is its bottom"

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            rows = self.blob(0).view(self.param.inner_product_param.num_output, -1)
            rows.div_((rows.square().sum(1, keepdim=True) + 1e-6).sqrt())
        return super().forward(data)


@register("LabelSpecificAdd", "label_specific_add_param")
class LabelSpecificAdd(Layer):
    """Add a bias to the score of each item's label if the score is above -bias, in TRAIN only: AM-Softmax's margin.

    With bias_base, the bias of pass i, starting at ``iteration``, is bias_base + (1 + bias_gamma i)^bias_power - 1,
    within bias_min and bias_max. The gradient is that of the top.

    bottom[0]  scores (N, ...)
    bottom[1]  labels (N,)
    top[0]     the shape of bottom[0]
    top[1]     optional: the bias (1,)
    Fork: happynear/caffe-windows, src/caffe/layers/label_specific_add.cpp
    """

    bottoms, tops = (2, 2), (1, 2)
    label_bottoms = frozenset({1})
    not_exported = "it is for training"

    def setup(self) -> None:
        self.settings = value(self.param, "label_specific_add_param")
        self.passes, self.bias = int(self.settings.iteration), self.settings.bias

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        scores, labels = (torch.Size(shape) for shape in bottom_shapes)
        if labels.numel() != (scores[0] if scores else 0):
            raise self.error(f"found {labels.numel()} labels for scores of shape {bottom_shapes[0]}", "bottom", 1)
        return [bottom_shapes[0], (1,)][: self.num_tops]

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        p, top = self.settings, scores
        if self.phase != TEST:
            if p.HasField("bias_base"):
                with np.errstate(all="ignore"):  # NaN or infinity, as in C; Python raises an error
                    bias = p.bias_base + float(np.float64(1 + p.bias_gamma * self.passes) ** p.bias_power) - 1
                self.bias = min(max(bias, p.bias_min), p.bias_max)
                self.passes += 1
            flat, labels = scores.detach()[..., None].flatten(1), labels.reshape(-1, 1).long()
            if labels.numel() and not 0 <= int(labels.min()) <= int(labels.max()) < flat.shape[1]:
                raise self.error(f"found a label outside 0 to {flat.shape[1] - 1}", "bottom", 1)
            added = torch.where(flat.gather(1, labels) > -self.bias, self.bias, 0.0)
            top = scores + torch.zeros_like(flat).scatter_(1, labels, added).view_as(scores)
        return top if self.num_tops == 1 else (top, scores.new_full((1,), self.bias))

    def running_state(self) -> State:
        return {"passes": self.passes}

    def resume(self, state: Mapping[str, Any]) -> None:
        self.passes = int(state["passes"])


@register("TripletLoss", "triplet_loss_param")
class TripletLoss(Loss):
    """Sum of max(margin + |a - p|^2 - |a - n|^2, 0), divided by 2 N.

    bottom[0]  vectors a (N, C)
    bottom[1]  vectors p of the same class, the same shape
    bottom[2]  vectors n of another class, the same shape
    top[0]     the loss, ()
    Fork: happynear/caffe-windows, src/caffe/layers/triplet_loss_layer.cpp
    """

    bottoms = (3, 3)
    label_bottoms = frozenset()
    not_exported = "it is for training"

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shapes = [torch.Size(shape) for shape in bottom_shapes]
        if any(shape != shapes[0] or shape.numel() != shape[:2].numel() for shape in shapes):
            raise self.error(f"found bottoms of shapes {bottom_shapes}, expected three of one shape (N, C)", "bottom")
        return [()]

    def forward(self, a: torch.Tensor, p: torch.Tensor, n: torch.Tensor) -> torch.Tensor:
        near, far = ((a - other).flatten(1).square().sum(1) for other in (p, n))
        return F.relu(value(self.param, "triplet_loss_param").margin + near - far).sum() / (2 * len(a))


ONEADDP = 2  # FocalLossParameter.Type


def _focal(
    x: torch.Tensor, labels: torch.Tensor, base: float, gamma: float, sign: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return -(base -+ p)^gamma log(p) for each label's p, and the softmax. The gradient is right if base is 1."""
    softmax = x.detach().softmax(1)
    p = softmax.gather(1, labels)
    factor, log = (base + sign * p) ** gamma, p.clamp(min=FLT_MIN).log()
    along = sign * gamma * (factor / (1 + sign * p).clamp(min=1e-10)) * log * p + factor
    return with_gradient_of(lambda: -along * x.log_softmax(1).gather(1, labels), -factor * log), softmax


@register("FocalLoss", "focal_loss_param", "loss_param", "softmax_param")
class FocalLoss(Loss, Classified):
    """-(alpha - p)^gamma log(p), where p is the softmax of the label; (alpha + p)^gamma with type: ONEADDP.

    In nets of detectors (rcnn, ssd), it is zimenglan's: -alpha (1 - p)^gamma log(p) with a default alpha of 0.25.

    bottom[0]  scores (N, C, ...), C at softmax_param.axis
    bottom[1]  labels, one per prediction
    top[0]     the loss, (): the sum, normalized according to loss_param (default VALID)
    top[1]     optional: the softmax, in bottom[0]'s shape; its gradient is ignored
    Fork: happynear/caffe-windows, src/caffe/layers/focal_loss_layer.cpp; zimenglan-sysu-512/Focal-Loss, that of the
    paper (Lin et al., ICCV 2017)
    """

    tops = (1, 2)
    not_exported = "it is for training"

    def setup(self) -> None:
        self.settings = p = value(self.param, "focal_loss_param")
        for name, wrong, expected in (("alpha", p.alpha <= 0, "above 0"), ("gamma", p.gamma < 0, "at least 0")):
            if wrong:
                message = f"{name} must be {expected}, found {getattr(p, name):g}"
                raise self.error(message, "focal_loss_param", name)
        self.base, self.factor = p.alpha, 1.0
        if self.context.fork == "rcnn":
            self.base, self.factor = 1.0, p.alpha if p.HasField("alpha") else 0.25
        self.ignored = ignore_label(self.param.loss_param)
        self.normalization = normalization_mode(self.param.loss_param, VALID)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.reshape_scores(bottom_shapes, self.param.softmax_param.axis, "softmax_param", "axis")
        return [(), bottom_shapes[0]][: self.num_tops]

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        x, labels = self.scores_and_labels(scores, labels)
        valid, p = self.valid(labels, self.ignored), self.settings
        used = (labels if valid is None else labels * valid).unsqueeze(1)
        losses, softmax = _focal(x, used, self.base, p.gamma, 1 if p.type == ONEADDP else -1)
        losses = losses.squeeze(1) if valid is None else losses.squeeze(1) * valid
        loss = self.factor * losses.sum() / normalizer(self.normalization, self.outer, self.inner, valid)
        return loss if self.num_tops == 1 else (loss, softmax.reshape(scores.shape))


@register("Flip", "flip_param")
class Flip(Activation):
    """Mirror maps: horizontally unless flip_width is false, and vertically if flip_height is true.

    bottom[0]  (N, C, H, W)
    top[0]     the same shape
    Fork: happynear/caffe-windows, src/caffe/layers/flip_layer.cpp
    """

    def setup(self) -> None:
        param, axes = value(self.param, "flip_param"), len(self.bottom_shapes[0])
        flipped = ((2, param.flip_height), (3, param.flip_width))
        self.axes = [axis for axis, wanted in flipped if wanted and axis < axes]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data.flip(self.axes)


@register("ChannelScale", "channel_scale_param")
class ChannelScale(NotLearned):
    """Multiply all channels of a pixel by a number; with global_scale, multiply everything by a running mean of them.

    do_forward: false does not change the maps, and do_backward_feature: false does not change their gradient. With
    do_backward_scale: false, the numbers have no gradient. With global_scale, the gradients are the same as without.

    bottom[0]  (N, C, ...)
    bottom[1]  the numbers (N, 1, ...)
    top[0]     the shape of bottom[0]
    top[1]     optional, with global_scale: the scale (1,)
    blobs[0]   with global_scale: the scale (1,), limited to its bounds; below 0 before the first pass
    Fork: happynear/caffe-windows, src/caffe/layers/channel_scale_layer.cu; its code for CPUs keeps no running mean
    """

    bottoms, tops = (2, 2), (1, 2)
    not_exported = "its scale is for training"

    def setup(self) -> None:
        self.settings = p = value(self.param, "channel_scale_param")
        if p.global_scale:
            self.add_blob((1,), value=-1.0)
            self.not_learned = frozenset({0})
        elif self.num_tops > 1:
            raise self.error("a second top is there with global_scale only", "top", 1)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        maps, scales = (torch.Size(shape) for shape in bottom_shapes)
        if len(maps) < 2 or scales.numel() * maps[1] != maps.numel() or scales[0] != maps[0]:
            message = f"found bottoms of shapes {bottom_shapes}, expected (N, C, ...) and (N, 1, ...)"
            raise self.error(message, "bottom", 1)
        return [bottom_shapes[0], (1,)][: self.num_tops]

    def forward(self, maps: torch.Tensor, scales: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        p, scales = self.settings, scales.reshape(len(maps), 1, *maps.shape[2:])
        factor = scales.detach()
        if p.global_scale:
            with torch.no_grad():
                factor = self._averaged(self.blob(0), scales.abs().mean()).clone()
        used = factor if p.do_forward else torch.ones_like(factor)
        used = used.reshape(1, *[1] * (maps.dim() - 1)) if p.global_scale else used
        of_maps = maps * scales.detach() if p.do_backward_feature else maps
        of_scales = maps.detach() * int(p.do_backward_scale) * scales
        top = with_gradient_of(lambda: of_maps + of_scales, maps * used)
        return top if self.num_tops == 1 else (top, factor)

    def _averaged(self, scale: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
        """Return the scale; in TRAIN, it moves by 1/100 to the new mean; the first mean replaces it."""
        if self.phase == TEST:
            return scale
        p, found = self.settings, torch.where(scale < 0, mean, 0.99 * scale + 0.01 * mean)
        return scale.copy_(found.clamp(p.min_global_scale, p.max_global_scale))


@register("Cosine")
class Cosine(Activation):
    """The cosine of each number.

    bottom[0]  any shape
    top[0]     the same shape
    Fork: happynear/caffe-windows, src/caffe/layers/cosine_layer.cu; its gradient for CPUs omits that of the top
    """

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data.cos()


@register("Arccos")
class Arccos(Cosine):
    """The arc cosine of each number, NaN beyond 1; above 0.99, the gradient is that at 0.99.

    Fork: happynear/caffe-windows, src/caffe/layers/arccos_layer.cpp
    """

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return with_gradient_of(lambda: -data / (1 - data.detach().clamp(max=0.99) ** 2).sqrt(), data.acos())
