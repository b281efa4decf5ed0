"""Face recognition: the center loss, and products with an angular margin.

Forks: ydwen/caffe-face, wy1iu/sphereface, wy1iu/LargeMargin_Softmax_Loss; happynear/caffe-windows has them all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from typing_extensions import override

from netspec.dialects.checks import check_at_least_1
from netspec.dialects.faces.margins import MarginProduct
from netspec.dialects.gradients import with_gradient_of
from netspec.layers import register
from netspec.layers.contract.base import Shape
from netspec.layers.loss.base import Classified, Loss
from netspec.proto.schema import value

DECLARATIONS = """
message CenterLossParameter {
  optional uint32 num_output = 1;
  optional FillerParameter center_filler = 2;
  optional int32 axis = 3 [default = 1];
  optional string distance_type = 29 [default = "L2"];
}
message MarginInnerProductParameter {
  optional uint32 num_output = 1;
  enum MarginType { SINGLE = 0; DOUBLE = 1; TRIPLE = 2; QUADRUPLE = 3; }
  optional MarginType type = 2 [default = SINGLE];
  optional FillerParameter weight_filler = 3;
  optional int32 axis = 4 [default = 1];
  optional float base = 5 [default = 1];
  optional float gamma = 6 [default = 0];
  optional float power = 7 [default = 1];
  optional int32 iteration = 8 [default = 0];
  optional float lambda_min = 9 [default = 0];
}
extend LayerParameter {
  optional CenterLossParameter center_loss_param = 1230;
  optional MarginInnerProductParameter margin_inner_product_param = 1231;
}
"""


class _Distance(torch.autograd.Function):
    """Distances to the centers, summed and divided by M. The gradient of the centers is not the derivative.

    It is the sum of the differences of a class, divided by 1 + their number n, and not scaled by the loss weight;
    happynear's code adds it n times.
    """

    @staticmethod
    def forward(
        ctx: Any, x: torch.Tensor, centers: torch.Tensor, labels: torch.Tensor, absolute: bool, n_times: bool
    ) -> torch.Tensor:
        difference = x - centers[labels]
        ctx.save_for_backward(difference.sign() if absolute else difference, labels)
        ctx.classes, ctx.n_times = len(centers), n_times
        return (difference.abs().sum() if absolute else difference.square().sum() / 2) / len(x)

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        difference, labels = ctx.saved_tensors
        number = torch.bincount(labels, minlength=ctx.classes).to(difference).unsqueeze(1)
        sums = torch.zeros(ctx.classes, difference.shape[1]).to(difference).index_add_(0, labels, -difference)
        step = sums / (number + 1) * (number if ctx.n_times else 1)
        return difference * (grads[0] / len(difference)), step, None, None, None


@register("CenterLoss", "center_loss_param")
class CenterLoss(Loss, Classified):
    """Half the squared distances of vectors to the centers of their classes, divided by their number M.

    With distance_type: "L1" (happynear's), the sums of absolute differences. Without loss_weight, it is not a loss.

    bottom[0]  (M, ...): vectors of length K from ``axis`` on
    bottom[1]  labels (M,)
    top[0]     the loss, ()
    blobs[0]   the centers (num_output, K)
    Fork: ydwen/caffe-face, happynear/caffe-windows, src/caffe/layers/center_loss_layer.cpp
    """

    not_exported = "it is for training"

    @property
    @override
    def default_loss_weight(self) -> float:
        return 0.0

    def setup(self) -> None:
        p, shape = value(self.param, "center_loss_param"), self.bottom_shapes[0]
        check_at_least_1(self, "center_loss_param", "num_output")
        if p.distance_type not in ("L1", "L2"):
            message = f'found "{p.distance_type}", expected "L1" or "L2"'
            raise self.error(message, "center_loss_param", "distance_type")
        self.absolute, self.classes = p.distance_type == "L1", p.num_output
        axis = self.canonical_axis(p.axis, shape, "center_loss_param", "axis")
        self.length = torch.Size(shape[axis:]).numel()
        self.add_blob((p.num_output, self.length), p.center_filler)
        self.n_times = self.context.fork == "happynear"

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        vectors, labels = (torch.Size(shape) for shape in bottom_shapes)
        if vectors.numel() != vectors[0] * self.length or labels.numel() != vectors[0]:
            message = f"found bottoms of shapes {vectors} and {labels}, expected (M, {self.length}) and (M,)"
            raise self.error(message.replace("torch.Size", ""), "bottom")
        return [()]

    def forward(self, x: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        labels = labels.flatten().long()
        self.valid(labels, None)
        return _Distance.apply(x.reshape(-1, self.length), self.blob(0), labels, self.absolute, self.n_times)


@register("MarginInnerProduct", "margin_inner_product_param")
class MarginInnerProduct(MarginProduct):
    """The angular softmax of SphereFace: products with weights that each pass normalizes to length 1.

    At the label, it is (|x| psi(angle) + lambda x w) / (1 + lambda). The gradient is the fork's: at the label, its two
    parts are divided by their common length; that of the weights is as without a margin.
    Fork: wy1iu/sphereface, src/caffe/layers/margin_inner_product_layer.cpp
    """

    message = "margin_inner_product_param"

    @override
    def products(self, x: torch.Tensor, labels: torch.Tensor, share: float) -> torch.Tensor:
        weight = self.blob(0)
        with torch.no_grad():
            weight.div_(weight.norm(dim=1, keepdim=True))
        top, at_labels = x @ weight.t(), labels[:, None]
        if self.margin is None:
            return top
        with torch.no_grad():
            length, plain = x.norm(dim=1, keepdim=True), top.gather(1, at_labels)
            found, slope = self.margin(plain / length)
            along = (found - plain / length * slope) / length  # the factor of x in the derivative
            both = torch.hypot(slope, along)
            step = share * ((slope / both - 1) * weight[labels] + along / both * x)
            value = top.scatter_add(1, at_labels, share * (length * found - plain))
        return with_gradient_of(lambda: top.scatter_add(1, at_labels, (step * x).sum(1, keepdim=True)), value)
