"""Fields that forks added to Caffe's layers.

DeepLab's hole; separate pads for each side, AVE_EXC_PAD and relu6 (Synopsys); a Dropout that scales in testing (Fast
R-CNN) or is random in testing (SegNet).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.dialects.blocks.relu6 import Capped
from netspec.dialects.layers import replace
from netspec.dialects.registry import added_value
from netspec.layers import common
from netspec.layers.contract.base import Shape
from netspec.layers.vision import convolution, pooling, windows
from netspec.proto.schema import TRAIN, LayerParameter, has, value

DECLARATIONS = """
extend ConvolutionParameter {
  optional uint32 hole = 1016 [default = 1];
  optional uint32 hole_h = 1017;
  optional uint32 hole_w = 1018;
  optional uint32 pad_l = 1036 [default = 0];
  optional uint32 pad_r = 1037 [default = 0];
  optional uint32 pad_t = 1038 [default = 0];
  optional uint32 pad_b = 1039 [default = 0];
}
enum PoolMethod { AVE_EXC_PAD = 3; AVE_TF = 4; }
extend PoolingParameter {
  optional PoolMethod pool = 1035;
  optional uint32 pad_l = 1036 [default = 0];
  optional uint32 pad_r = 1037 [default = 0];
  optional uint32 pad_t = 1038 [default = 0];
  optional uint32 pad_b = 1039 [default = 0];
}
extend ReLUParameter {
  optional bool relu6 = 1003 [default = false];
}
extend DropoutParameter {
  optional bool scale_train = 1002 [default = true];
  optional bool sample_weights_test = 1003 [default = false];
}
"""

GROUP = "convolution_param"
SIDES = ("pad_l", "pad_r", "pad_t", "pad_b")  # in the order of F.pad


@replace(
    "Convolution",
    GROUP,
    *(f"{GROUP}.{name}" for name in ("hole", "hole_h", "hole_w", *SIDES)),
)
class Convolution(convolution.Convolution):
    """Caffe's Convolution, with ``hole`` as an older name of dilation, and pad_l, pad_r, pad_t and pad_b.

    bottom[i]  (N, C, H, W)
    top[i]     (N, num_output, H', W'),  H' = (H + pad_t + pad_b - dilation (kernel - 1) - 1) // stride + 1
    blobs[0]   filters (num_output, C / group, kernel_h, kernel_w)
    blobs[1]   bias    (num_output,)                                   unless bias_term: false
    Fork: DeepLab (hole); foss-for-synopsys-dwc-arc-processors/synopsys-caffe, src/caffe/layers/base_conv_layer.cpp
    """

    @override
    def read_geometry(self) -> None:
        super().read_geometry()
        param = self.param.convolution_param
        holes = [name for name in ("hole", "hole_h", "hole_w") if has(param, name)]
        if holes and (param.dilation or holes not in (["hole"], ["hole_h", "hole_w"])):
            message = f"expected dilation, or hole, or both hole_h and hole_w; found {' and '.join(holes)}"
            raise self.error(message + (" and dilation" if param.dilation else ""), GROUP, holes[0])
        if holes:
            self.dilation = tuple(value(param, name) for name in (holes * self.spatial_axes)[: self.spatial_axes])
            if min(self.dilation, default=1) < 1:
                raise self.error(f"{holes[0]} must be at least 1", GROUP, holes[0])
        self.sides = [value(param, name) for name in SIDES]
        first = next((name for name in (*SIDES, "hole_h") if value(param, name)), "")
        if any(self.sides) and any(self.pad):
            raise self.error(f"found both pad and {first}; give one of them", GROUP, first)
        if first and self.spatial_axes != 2:
            raise self.error(f"{first} is for 2 spatial axes, the bottom has {self.spatial_axes}", GROUP, first)

    def _padded_shape(self, shape: Shape) -> Shape:
        """Return a bottom's shape including the pads of its sides."""
        left, right, top, bottom = self.sides
        if not any(self.sides) or len(shape) < 2:
            return shape
        return (*shape[:-2], shape[-2] + top + bottom, shape[-1] + left + right)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return super().reshape([self._padded_shape(shape) for shape in bottom_shapes])

    @override
    def overhang(self, shape: Shape) -> list[int]:
        return super().overhang(self._padded_shape(shape))

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        if any(self.sides):
            bottoms = tuple(F.pad(bottom, self.sides) for bottom in bottoms)
        return super().forward(*bottoms)


POOLING = "pooling_param"


def _differs(param: LayerParameter) -> bool:
    """Return whether a Pooling layer has one of these fields."""
    p = param.pooling_param
    return bool(added_value(p, "pool")) or any(value(p, name) for name in SIDES)


@replace("Pooling", POOLING, *(f"{POOLING}.{name}" for name in ("pool", *SIDES)), where=_differs)
class Pooling(pooling.Pooling):
    """Caffe's Pooling, with pad_l, pad_r, pad_t and pad_b, and AVE_EXC_PAD, the mean without padding.

    With AVE, padding counts as zeros, up to the pad of each side. AVE_TF is an older name of AVE_EXC_PAD.

    bottom[0]  (N, C, H, W)
    top[0]     (N, C, H', W'),  H' = ceil((H + pad_t + pad_b - kernel) / stride) + 1 by Caffe's rules
    top[1]     only without these fields, as in Caffe
    Fork: foss-for-synopsys-dwc-arc-processors/synopsys-caffe, src/caffe/layers/pooling_layer.cpp
    """

    not_exported = "it has no pooling with a pad for each side, or of pixels alone"

    def setup(self) -> None:
        super().setup()
        param = self.param.pooling_param
        self.pixels_only = bool(added_value(param, "pool"))
        if self.pixels_only:
            self.method = pooling.AVE
        if self.method == pooling.STOCHASTIC:
            raise self.error("STOCHASTIC pooling does not support padding", POOLING)
        if self.num_tops > 1:
            raise self.error("there is no mask with AVE_EXC_PAD or a pad for each side", "top", 1)
        left, right, up, down = (value(param, name) for name in SIDES)
        if any((left, right, up, down)) and any(self.pad):
            raise self.error("found both pad and a pad for each side; give one of them", POOLING)
        self.sides = ((up, down), (left, right)) if any((left, right, up, down)) else [(p, p) for p in self.pad]

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the top; the pad of each side must be less than the kernel."""
        shape, param = bottom_shapes[0], self.param.pooling_param
        if len(shape) != 4:
            raise self.error(f"pooling needs a bottom of 4 axes (N, C, H, W), found shape {shape}", "bottom")
        self.kernel = (shape[2], shape[3]) if param.global_pooling else self.kernel
        counts, self.frame, self.lengths = [], [], []
        for size, kernel, stride, (before, after) in zip(shape[2:], self.kernel, self.stride, self.sides, strict=True):
            if max(before, after) >= kernel > 1 or (kernel == 1 and before + after):
                raise self.error(f"a pad of {max(before, after)} must be less than the kernel {kernel}", POOLING)
            free = size + before + after - kernel
            count = (free // stride if param.round_mode == windows.FLOOR else -(-free // stride)) + 1
            count -= any(map(any, self.sides)) and (count - 1) * stride >= size + before
            if count < 1 or (count - 1) * stride - before >= size:
                fault = f"no window of {kernel} at stride {stride} fits {size} pixels, or one lies outside"
                raise self.error(fault, POOLING)
            counts.append(count)
            self.frame = [before, (count - 1) * stride + kernel - before - size, *self.frame]
            starts = [i * stride - before for i in range(count)]
            limits = (0, size) if self.pixels_only else (-before, size + after)
            self.lengths.append([min(start + kernel, limits[1]) - max(start, limits[0]) for start in starts])
        return [(*shape[:2], *counts)]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        if self.method == pooling.MAX:
            return F.max_pool2d(F.pad(data, self.frame, value=windows.LOWEST), self.kernel, self.stride)
        sums = F.avg_pool2d(F.pad(data, self.frame), self.kernel, self.stride, divisor_override=1)
        return sums / self.areas().to(data)

    def areas(self) -> torch.Tensor:
        """Return the number of pixels that each window counts (down, across)."""
        return torch.outer(*(torch.tensor(lengths, dtype=torch.float64) for lengths in self.lengths))


@replace(
    "ReLU",
    "relu_param",
    "relu_param.relu6",
    where=lambda param: value(param.relu_param, "relu6"),
)
class ReLU(Capped):
    """Caffe's ReLU; with relu6, limited to 6: min(max(x, 0) + negative_slope min(x, 0), 6).

    bottom[0]  any shape
    top[0]     the same shape
    Fork: foss-for-synopsys-dwc-arc-processors/synopsys-caffe, src/caffe/layers/relu_layer.cpp
    """


@replace(
    "Dropout",
    "dropout_param",
    "dropout_param.scale_train",
    "dropout_param.sample_weights_test",
)
class Dropout(common.Dropout):
    """Caffe's Dropout; with scale_train: false, it scales by 1 - p in testing instead of scaling in training.

    With sample_weights_test, it is random in testing too, for the samples of Bayesian SegNet.

    bottom[0]  any shape
    top[0]     the same shape
    Fork: rbgirshick/caffe-fast-rcnn; alexgkendall/caffe-segnet, src/caffe/layers/dropout_layer.cpp
    """

    def setup(self) -> None:
        super().setup()
        if value(self.param.dropout_param, "sample_weights_test"):
            self.phase = TRAIN

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        top = super().forward(data)
        return top if value(self.param.dropout_param, "scale_train") else top * (1 - self.ratio)

    @property
    def passes_on(self) -> bool:
        """Whether the top is the bottom, unchanged."""
        return super().passes_on and value(self.param.dropout_param, "scale_train")
