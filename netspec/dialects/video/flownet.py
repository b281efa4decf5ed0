"""FlowNet and FlowNet 2: maps of two images compared, resampled and warped. Fork: lmb-freiburg/flownet2.

Its augmenting, reading and writing layers, and its losses, are not here: nets run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
import torch.nn.functional as F

from netspec.layers import Layer, register
from netspec.layers.contract.base import Shape
from netspec.proto.schema import value

DECLARATIONS = """
message CorrelationParameter {
  enum CorrelationType { MULTIPLY = 0; SUBTRACT = 1; }
  optional uint32 pad = 2 [default = 0];
  optional uint32 kernel_size = 3;
  optional uint32 max_displacement = 4;
  optional uint32 stride_1 = 5 [default = 1];
  optional uint32 stride_2 = 6 [default = 1];
  optional bool do_abs = 7 [default = false];
  optional int32 single_direction = 8 [default = 0];
  optional CorrelationType correlation_type = 15 [default = MULTIPLY];
}
message ResampleParameter {
  enum ResampleType { NEAREST = 1; LINEAR = 2; CUBIC = 3; AREA = 4; }
  optional uint32 width = 1;
  optional uint32 height = 2;
  optional ResampleType type = 3 [default = LINEAR];
  optional bool antialias = 4 [default = true];
  optional float factor = 5 [default = 1.0];
}
message FlowWarpParameter {
  enum FillParameter { ZERO = 1; NOT_A_NUMBER = 2; }
  optional FillParameter fill_value = 1 [default = ZERO];
}
extend LayerParameter {
  optional CorrelationParameter correlation_param = 1210;
  optional ResampleParameter resample_param = 1211;
  optional FlowWarpParameter flow_warp_param = 1212;
  optional bool reshape_every_iter = 1213 [default = true];
}
"""

SUBTRACT, NEAREST, CUBIC, AREA, NOT_A_NUMBER = 1, 1, 3, 4, 2  # values of the enums above


class _OfMaps(Layer):
    """A layer that is not exported, and of which all bottoms have four axes."""

    not_exported = "FlowNet's layers have no counterpart there"
    same: ClassVar[slice]  # the axes in which both bottoms are alike

    def check_maps(self, bottom_shapes: Sequence[Shape]) -> None:
        """Refuse bottoms without four axes, or that differ in those of ``same``."""
        first = bottom_shapes[0]
        for i, shape in enumerate(bottom_shapes):
            if len(shape) != 4 or shape[self.same] != first[self.same]:
                raise self.error(f"found a bottom of shape {shape}, the first has {first}, expected maps", "bottom", i)


@register("Correlation", "correlation_param")
class Correlation(_OfMaps):
    """Compare patches of one image's maps with those of the other's, moved by up to max_displacement pixels.

    A patch of kernel_size pixels around each stride_1-th pixel; its mean product with (SUBTRACT: its mean absolute
    difference from) the other's patch, moved by multiples of stride_2 pixels. pad zeros are around both.

    bottom[0]  (N, C, H, W)
    bottom[1]  the same shape
    top[0]     (N, D D, H', W'),  D = 2 (max_displacement // stride_2) + 1, displacements row after row,
               H' = ceil((H + 2 pad - 2 max_displacement - kernel_size + 1) / stride_1)
    Paper: Fischer et al., FlowNet, ICCV 2015, section 3. Fork: src/caffe/layers/correlation_layer.cu
    """

    bottoms = (2, 2)
    same = slice(None)

    def setup(self) -> None:
        self.settings = p = value(self.param, "correlation_param")
        for name, least in (("kernel_size", 1), ("stride_1", 1), ("stride_2", 1)):
            if getattr(p, name) < least:
                raise self.error(f"{name} must be at least {least}", "correlation_param", name)
        if p.kernel_size % 2 == 0 or p.single_direction or p.do_abs:
            found = f"found kernel_size {p.kernel_size}, single_direction {p.single_direction}, do_abs {p.do_abs}"
            raise self.error(f"expected an odd kernel_size, and both directions without do_abs; {found}")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.check_maps(bottom_shapes)
        p, (images, _, *sides) = self.settings, bottom_shapes[0]
        border = 2 * p.pad - 2 * p.max_displacement - p.kernel_size + 1
        size = [-(-(side + border) // p.stride_1) for side in sides]
        if min(size) < 1:
            raise self.error(f"the top would have no pixel, {size[0]} x {size[1]}", "correlation_param")
        return [(images, (2 * (p.max_displacement // p.stride_2) + 1) ** 2, *size)]

    def forward(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        p, (_, _, *size) = self.settings, self.top_shapes[0]
        height, width = ((side - 1) * p.stride_1 + p.kernel_size for side in size)
        first, second = (F.pad(maps, [p.pad] * 4) for maps in (first, second))
        most = p.max_displacement
        patches = first[:, :, most : most + height, most : most + width]
        reach = range(-(most // p.stride_2) * p.stride_2, most + 1, p.stride_2)
        tops = []
        for y in (most + move for move in reach):
            for x in (most + move for move in reach):
                others = second[:, :, y : y + height, x : x + width]
                each = (patches - others).abs() if p.correlation_type == SUBTRACT else patches * others
                tops.append(each.mean(dim=1, keepdim=True))
        return F.avg_pool2d(torch.cat(tops, dim=1), p.kernel_size, p.stride_1)


@register("Resample", "resample_param")
class Resample(_OfMaps):
    """Bring maps to another size. A pixel is the weighted mean of those near its place: LINEAR, CUBIC, or the NEAREST.

    Where a side shrinks, the weights reach over as many more pixels, unless antialias is false. No gradient passes.

    bottom[0]  (N, C, H, W)
    bottom[1]  optional: maps of the new size; their values do not count
    top[0]     (N, C, H', W'), of height and width, or of bottom[1]
    Fork: src/caffe/layers/resample_layer.cu, which places columns by half a row's step and rows by half a column's
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({0, 1})
    same = slice(0, 0)

    def setup(self) -> None:
        self.settings = value(self.param, "resample_param")
        if self.settings.type == AREA:
            raise self.error("AREA is not there, in the fork neither", "resample_param", "type")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.check_maps(bottom_shapes)
        size = (self.settings.height, self.settings.width) if len(bottom_shapes) == 1 else bottom_shapes[1][2:]
        if min(size) < 1:
            raise self.error("height and width must be at least 1", "resample_param")
        return [(*bottom_shapes[0][:2], *size)]

    def forward(self, maps: torch.Tensor, *others: torch.Tensor) -> torch.Tensor:
        steps = [old / new for old, new in zip(maps.shape[2:], self.top_shapes[0][2:], strict=True)]
        rows, columns = (self._weights(maps, axis, steps).to(maps) for axis in (0, 1))
        return torch.einsum("yh,nchw,xw->ncyx", rows, maps, columns)

    def _weights(self, maps: torch.Tensor, axis: int, steps: Sequence[float]) -> torch.Tensor:
        """Return the weights (new, old) of an axis; those of a pixel add up to 1, or are all 0."""
        old, new, p = maps.shape[2 + axis], self.top_shapes[0][2 + axis], self.settings
        places = torch.arange(new) * steps[axis] + steps[1 - axis] / 2 - 0.5
        if p.type == NEAREST:
            return F.one_hot((places + 0.5).floor().long().clamp(0, old - 1), old)
        smooth = max(steps) > 1 and p.antialias
        away = (places[:, None] - torch.arange(old)).abs() / (steps[axis] if smooth else 1)
        weights = _cubic(away) if p.type == CUBIC else (1 - away).clamp(min=0)
        total = weights.sum(dim=1, keepdim=True)
        return weights / total.where(total != 0, 1)


def _cubic(x: torch.Tensor) -> torch.Tensor:
    """Return the weight of a pixel that is ``x`` pixels away, Keys' with a = -1/2."""
    near, far = (1.5 * x - 2.5) * x * x + 1, ((2.5 - 0.5 * x) * x - 4) * x + 2
    return torch.where(x <= 1, near, torch.where(x < 2, far, 0))


@register("FlowWarp", "flow_warp_param")
class FlowWarp(_OfMaps):
    """Move an image by a flow: each pixel is what lies, between four pixels of the image, where the flow points.

    bottom[0]  the image (N, C, H, W)
    bottom[1]  the flow (N, 2, H, W): x, then y
    top[0]     (N, C, H, W); 0, or with NOT_A_NUMBER that, where the flow points out of the image
    Fork: src/caffe/layers/flow_warp_layer.cpp
    """

    bottoms = (2, 2)
    same = slice(2, None)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.check_maps(bottom_shapes)
        if bottom_shapes[1][:2] != (bottom_shapes[0][0], 2):
            raise self.error(f"found a flow of shape {bottom_shapes[1]}, expected (N, 2, H, W)", "bottom", 1)
        return [bottom_shapes[0]]

    def forward(self, image: torch.Tensor, flow: torch.Tensor) -> torch.Tensor:
        height, width = image.shape[2:]
        grid = torch.meshgrid(*(torch.arange(side, device=flow.device) for side in (height, width)), indexing="ij")
        x, y = flow[:, 0] + grid[1], flow[:, 1] + grid[0]
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        x, y = (place.where(inside, 0) for place in (x, y))
        left, top = x.detach().floor(), y.detach().floor()
        right, low = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
        across, down = (x - left)[:, None], (y - top)[:, None]
        pixels = image.flatten(2)

        def at(row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
            index = (row * width + column).long().flatten(1)[:, None].expand_as(pixels)
            return pixels.gather(2, index).reshape(image.shape)

        upper = (1 - across) * at(top, left) + across * at(top, right)
        lower = (1 - across) * at(low, left) + across * at(low, right)
        fill = float("nan") if value(self.param, "flow_warp_param").fill_value == NOT_A_NUMBER else 0.0
        return ((1 - down) * upper + down * lower).where(inside[:, None], fill)


@register("ChannelNorm")
class ChannelNorm(_OfMaps):
    """The length of the vector of channels at each pixel.

    bottom[0]  (N, C, H, W)
    top[0]     (N, 1, H, W)
    Fork: src/caffe/layers/channel_norm_layer.cpp
    """

    same = slice(0, 0)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.check_maps(bottom_shapes)
        return [(bottom_shapes[0][0], 1, *bottom_shapes[0][2:])]

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        return maps.norm(dim=1, keepdim=True)
