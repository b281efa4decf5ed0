"""Layers that only rearrange values: Transpose (OCR), Reorg (YOLO v2), MergeCrop (U-Net), CropCenter (waifu2x)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from netspec.dialects.blocks.order import Reordered
from netspec.dialects.checks import check_at_least_1
from netspec.layers import Layer, register
from netspec.layers.contract.base import Shape
from netspec.proto.schema import value

DECLARATIONS = """
message TransposeParameter {
  repeated int32 dim = 1;
}
message ReorgParameter {
  optional uint32 stride = 1;
  optional bool reverse = 2 [default = false];
}
message MergeCropParameter {
  enum MergeOp { STACK = 0; ADD = 1; }
  repeated bool forward = 1;
  repeated bool backward = 2;
  optional MergeOp operation = 3 [default = STACK];
}
message CropCenterParameter {
  repeated uint32 crop_size = 1;
}
extend LayerParameter {
  optional CropCenterParameter crop_center_param = 1148;
  optional TransposeParameter transpose_param = 1149;
  optional ReorgParameter reorg_param = 1155;
  optional MergeCropParameter mergecrop_param = 1156;
}
"""

STACK = 0  # MergeCropParameter.MergeOp


@register("Transpose", "transpose_param")
class Transpose(Reordered):
    """Permute the axes: axis i of the top is axis ``dim``[i] of the bottom.

    bottom[0]  any shape
    top[0]     its axes in the new order
    Fork: senlinuc/caffe_ocr and others, transpose_layer.cpp
    """

    def setup(self) -> None:
        """Read the order of the axes."""
        self.perm = list(value(self.param, "transpose_param").dim)
        axes = len(self.bottom_shapes[0])
        if sorted(self.perm) != list(range(axes)):
            message = f"found dim {self.perm}, expected each of the {axes} axes 0 to {axes - 1} once"
            raise self.error(message, "transpose_param", "dim")


@register("Reorg", "reorg_param")
class Reorg(Layer):
    """Convert pixels to channels, as Darknet does, which interprets the bottom's values with a different shape.

    The bottom is interpreted as C / s^2 channels of s H x s W pixels, where s is ``stride``. Pixel (s y + i, s x + j)
    of channel c becomes pixel (y, x) of channel (s i + j) C / s^2 + c. The result is reshaped to the top's shape. With
    ``reverse``, such a step is undone.

    bottom[0]  (N, C, H, W), C a multiple of s^2
    top[0]     (N, C s^2, H / s, W / s); with reverse (N, C / s^2, H s, W s)
    Fork: caffe-yolov2, reorg_layer.cpp; Darknet's reorg_cpu
    """

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        param, shape = value(self.param, "reorg_param"), bottom_shapes[0]
        self.stride: int = param.stride
        self.reverse: bool = param.reverse
        check_at_least_1(self, "reorg_param", "stride")
        area = self.stride**2
        fits = len(shape) == 4 and shape[1] % area == 0
        if not fits or (not self.reverse and any(size % self.stride for size in shape[2:])):
            sides = "" if self.reverse else f", and sides that are multiples of {self.stride}"
            message = f"found a bottom of shape {shape}, expected (N, C, H, W), C a multiple of {area}{sides}"
            raise self.error(message, "bottom", 0)
        images, channels, height, width = shape
        if self.reverse:
            return [(images, channels // area, height * self.stride, width * self.stride)]
        return [(images, channels * area, height // self.stride, width // self.stride)]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        images, channels, height, width = data.shape
        few, s = channels // self.stride**2, self.stride
        if self.reverse:
            moved = data.reshape(images, s, s, few, height, width).permute(0, 3, 4, 1, 5, 2)
        else:
            moved = data.reshape(images, few, height, s, width, s).permute(0, 3, 5, 1, 2, 4)
        return moved.reshape(self.top_shapes[0])


@register("MergeCrop", "mergecrop_param")
class MergeCrop(Layer):
    """Crop the center of a larger blob to the size of the smaller one; append it as channels, or add it.

    ``forward`` says for each bottom whether it is copied; if not, zeros are used. ``backward`` says whether it
    gets a gradient; by default only the first does.

    bottom[0]  the smaller (N, C, ...)
    bottom[1]  the larger (N, C', ...), with as many axes; with operation: ADD, C' = C
    top[0]     (N, C + C', ...) with the first bottom's size; with operation: ADD, its shape
    Fork: naibaf7/caffe, src/caffe/layers/mergecrop_layer.cu
    """

    bottoms = (2, 2)

    def setup(self) -> None:
        """Read ``forward`` and ``backward``."""
        param: Any = value(self.param, "mergecrop_param")
        for name in ("forward", "backward"):
            if len(getattr(param, name)) > 2:
                message = f"found {len(getattr(param, name))} {name}, expected one per bottom"
                raise self.error(message, "mergecrop_param", name)
        self.copied = [*param.forward, *(True, True)[len(param.forward) :]]
        self.learns = [*param.backward, *(True, False)[len(param.backward) :]]
        self.stacks: bool = param.operation == STACK

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        small, large = bottom_shapes
        fits = len(small) == len(large) > 2 and small[0] == large[0] and (self.stacks or small[1] == large[1])
        if not fits or any(a > b for a, b in zip(small[2:], large[2:], strict=True)):
            message = f"found bottoms of shapes {small} and {large}, expected a smaller one and one to cut to its size"
            raise self.error(message, "bottom")
        cuts = ((b - a) // 2 for a, b in zip(small[2:], large[2:], strict=True))
        self.window = (..., *(slice(cut, cut + a) for cut, a in zip(cuts, small[2:], strict=True)))
        return [(small[0], small[1] + large[1] * self.stacks, *small[2:])]

    def forward(self, small: torch.Tensor, large: torch.Tensor) -> torch.Tensor:
        parts = []
        for part, copied, learns in zip((small, large[self.window]), self.copied, self.learns, strict=True):
            part = part if learns else part.detach()
            parts.append(part if copied else torch.zeros_like(part))
        return torch.cat(parts, 1) if self.stacks else parts[0] + parts[1]


@register("CropCenter", "crop_center_param")
class CropCenter(Layer):
    """Crop both ends of each axis by ``crop_size``, which has one number for each axis.

    bottom[0]  any shape
    top[0]     as many axes; axis i is shorter by 2 crop_size[i]
    Fork: lltcggie/caffe, src/caffe/layers/crop_center_layer.cpp
    """

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shape, cuts = bottom_shapes[0], list(value(self.param, "crop_center_param").crop_size)
        if len(cuts) != len(shape) or any(size <= 2 * cut for size, cut in zip(shape, cuts, strict=False)):
            message = f"found crop_size {cuts}, expected one for each axis of {shape}, less than half of it"
            raise self.error(message, "crop_center_param", "crop_size")
        self.window = tuple(slice(cut, size - cut) for size, cut in zip(shape, cuts, strict=True))
        return [tuple(size - 2 * cut for size, cut in zip(shape, cuts, strict=True))]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data[self.window].clone()
