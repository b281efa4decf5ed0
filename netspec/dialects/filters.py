"""Fields that forks added to Convolution: the holes of DeepLab, and a pad of its own for each side (Synopsys)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.layers import register
from netspec.layers.base import Shape
from netspec.layers.exporting import refusal
from netspec.layers.preparing import Kernel, Preparation
from netspec.layers.targets import OnnxGraph, TorchCode
from netspec.layers.vision import convolution
from netspec.proto.schema import has, value

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
"""

GROUP = "convolution_param"
SIDES = ("pad_l", "pad_r", "pad_t", "pad_b")  # in the order of F.pad


@register(
    "Convolution",
    GROUP,
    *(f"{GROUP}.{name}" for name in ("hole", "hole_h", "hole_w", *SIDES)),
    replaces=convolution.Convolution,
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
            raise self.error(message + (" beside dilation" if param.dilation else ""), GROUP, holes[0])
        if holes:
            self.dilation = tuple(value(param, name) for name in holes * (self.spatial_axes // len(holes)))
            if min(self.dilation, default=1) < 1:
                raise self.error(f"{holes[0]} must be at least 1", GROUP, holes[0])
        self.sides = [value(param, name) for name in SIDES]
        if any(self.sides):
            first = next(name for name in SIDES if value(param, name))
            if any(self.pad):
                raise self.error(f"found both pad and {first}; give one of them", GROUP, first)
            if self.spatial_axes != 2:
                raise self.error(f"{first} is for 2 spatial axes, the bottom has {self.spatial_axes}", GROUP, first)

    def _framed(self, shape: Shape) -> Shape:
        """Return a bottom's shape with the pad of its sides."""
        left, right, top, bottom = self.sides
        if not any(self.sides) or len(shape) < 2:
            return shape
        return (*shape[:-2], shape[-2] + top + bottom, shape[-1] + left + right)

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return super().reshape([self._framed(shape) for shape in bottom_shapes])

    @override
    def overhang(self, shape: Shape) -> list[int]:
        return super().overhang(self._framed(shape))

    @override
    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        if any(self.sides):
            bottoms = tuple(F.pad(bottom, self.sides) for bottom in bottoms)
        return super().forward(*bottoms)

    absorbs = convolution.Convolution.absorbs
    absorb = convolution.Convolution.absorb
    fresh = True
    any_layout = True

    def prepare(self, how: Preparation) -> Kernel | None:
        return None if any(self.sides) else super().prepare(how)

    @override
    def onnx_geometry(self) -> dict[str, Any]:
        geometry = super().onnx_geometry()
        left, right, top, bottom = self.sides
        return geometry | {"pads": [top, left, bottom, right]} if any(self.sides) else geometry

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        if any(self.sides) and any(self.overhang(self.bottom_shapes[0])):
            raise refusal(self, "ONNX", "its filter is longer than the map")
        return super().to_onnx(graph, *bottoms)

    def to_torch(self, code: TorchCode, *bottoms: str) -> Sequence[str]:
        if any(self.sides):
            sides = tuple(self.sides)
            bottoms = tuple(code.call("F.pad({x}, {sides})", x=bottom, sides=sides) for bottom in bottoms)
        return super().to_torch(code, *bottoms)
