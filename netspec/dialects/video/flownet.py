"""FlowNet and FlowNet 2: comparing, resampling and warping maps of two images. Fork: lmb-freiburg/flownet2.

Its layers for augmentation, reading and writing are not supported.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
import torch.nn.functional as F

from netspec.data.mean import read_mean
from netspec.dialects.checks import check_at_least_1
from netspec.layers import Layer, register
from netspec.layers.activation import Activation
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
message AccumParameter {
  optional uint32 top_height = 1 [default = 0];
  optional uint32 top_width = 2 [default = 0];
  optional uint32 size_divisible_by = 3 [default = 0];
  optional bool have_reference = 4 [default = false];
}
message DownsampleParameter {
  optional uint32 top_height = 1 [default = 0];
  optional uint32 top_width = 2 [default = 0];
}
message L1LossParameter {
  optional bool l2_per_location = 1 [default = false];
  optional bool l2_prescale_by_channels = 2 [default = false];
  optional bool normalize_by_num_entries = 3 [default = false];
  optional float epsilon = 4 [default = 1e-2];
  optional float plateau = 3001 [default = 0];
}
message MeanParameter {
  enum MeanOperation { ADD = 1; SUBTRACT = 4; }
  optional MeanOperation operation = 1;
  optional string file = 2;
  repeated float value = 3;
  optional float mean_scale = 4 [default = 1];
  optional float input_scale = 5 [default = 1];
  optional float output_scale = 6 [default = 1];
}
extend LayerParameter {
  optional CorrelationParameter correlation_param = 1210;
  optional ResampleParameter resample_param = 1211;
  optional FlowWarpParameter flow_warp_param = 1212;
  optional bool reshape_every_iter = 1213 [default = true];
  optional L1LossParameter l1_loss_param = 1215;
  optional MeanParameter mean_param = 1216;
  optional DownsampleParameter downsample_param = 1217;
  optional AccumParameter accum_param = 1218;
}
"""

SUBTRACT, NEAREST, CUBIC, AREA, NOT_A_NUMBER, SUBTRACTED = 1, 1, 3, 4, 2, 4  # values of the enums above


class _OfMaps(Layer):
    """Base of layers that cannot be exported. All bottoms have four axes."""

    not_exported = "FlowNet's layers have no counterpart there"
    same: ClassVar[slice]  # the axes in which both bottoms are equal

    def check_maps(self, bottom_shapes: Sequence[Shape]) -> None:
        """Raise SpecError for bottoms without four axes, or that differ in the axes ``same``."""
        first = bottom_shapes[0]
        for i, shape in enumerate(bottom_shapes):
            if len(shape) != 4 or shape[self.same] != first[self.same]:
                raise self.error(f"found a bottom of shape {shape}, the first has {first}, expected maps", "bottom", i)


@register("Correlation", "correlation_param")
class Correlation(_OfMaps):
    """Compare patches of one image's maps with patches of the other's, displaced by up to max_displacement pixels.

    For a patch of kernel_size pixels around each stride_1-th pixel, the mean product with (SUBTRACT: the mean absolute
    difference from) the other's patch, displaced by multiples of stride_2 pixels. Both are padded with pad zeros.

    bottom[0]  (N, C, H, W)
    bottom[1]  the same shape
    top[0]     (N, D D, H', W'),  D = 2 (max_displacement // stride_2) + 1, displacements in row-major order,
               H' = ceil((H + 2 pad - 2 max_displacement - kernel_size + 1) / stride_1)
    Paper: Fischer et al., FlowNet, ICCV 2015, section 3. Fork: src/caffe/layers/correlation_layer.cu
    """

    bottoms = (2, 2)
    same = slice(None)

    def setup(self) -> None:
        self.settings = p = value(self.param, "correlation_param")
        check_at_least_1(self, "correlation_param", "kernel_size", "stride_1", "stride_2")
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
    """Resize maps. A pixel is the weighted mean of the pixels near its position (LINEAR, CUBIC), or the NEAREST.

    If a side shrinks, the weights cover proportionally more pixels, unless antialias is false. It has no gradient.

    bottom[0]  (N, C, H, W)
    bottom[1]  optional: maps of the new size; their values are not used
    top[0]     (N, C, H', W') with the given height and width, or those of bottom[1]
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
        """Return the weights (new, old) of an axis; the sum for a pixel is 1 or 0."""
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
    """Return the weight of a pixel at distance ``x``: Keys' kernel with a = -1/2."""
    near, far = (1.5 * x - 2.5) * x * x + 1, ((2.5 - 0.5 * x) * x - 4) * x + 2
    return torch.where(x <= 1, near, torch.where(x < 2, far, 0))


@register("FlowWarp", "flow_warp_param")
class FlowWarp(_OfMaps):
    """Warp an image with a flow: each pixel is interpolated from four pixels at the position given by the flow.

    bottom[0]  the image (N, C, H, W)
    bottom[1]  the flow (N, 2, H, W): x, then y
    top[0]     (N, C, H, W); 0, or NaN with NOT_A_NUMBER, where the flow points outside the image
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
    """The L2 norm over the channels at each pixel.

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


@register("Accum", "accum_param")
class Accum(_OfMaps):
    """Resize maps to a common size with aligned corners, and concatenate their channels.

    The size is the largest of the bottoms, or top_height x top_width, or the next multiple of size_divisible_by,
    if both of its sides are larger; with have_reference, that of the last bottom, which is otherwise not used.

    bottom[i]  (N, C_i, H_i, W_i)
    top[0]     (N, sum of C_i, H, W)
    Fork: src/caffe/layers/accum_layer.cpp
    """

    bottoms = (1, None)
    same = slice(0, 1)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.check_maps(bottom_shapes)
        p = value(self.param, "accum_param")
        self.read = len(bottom_shapes) - p.have_reference
        if not self.read:
            raise self.error(
                "found one bottom, expected the maps to resize, and then the maps that have the new size", "bottom"
            )
        size = [max(sides) for sides in zip(*(shape[2:] for shape in bottom_shapes), strict=True)]
        wanted = [p.top_height, p.top_width]
        if p.size_divisible_by:
            wanted = [-(-side // p.size_divisible_by) * p.size_divisible_by for side in size]
        if p.have_reference:
            size = list(bottom_shapes[-1][2:])
        elif wanted[0] > size[0] and wanted[1] > size[1]:
            size = wanted
        return [(bottom_shapes[0][0], sum(shape[1] for shape in bottom_shapes[: self.read]), *size)]

    def forward(self, *maps: torch.Tensor) -> torch.Tensor:
        size = self.top_shapes[0][2:]
        return torch.cat(
            [F.interpolate(each, size, mode="bilinear", align_corners=True) for each in maps[: self.read]], 1
        )


@register("Downsample", "downsample_param")
class Downsample(_OfMaps):
    """Resize maps with aligned corners; a pixel is the mean of nearby pixels, weighted by their distance.

    NaN pixels are ignored; if they have more than half the weight of the others, the top is NaN.

    bottom[0]  (N, C, H, W)
    bottom[1]  optional: maps with the new size, instead of top_height and top_width
    top[0]     (N, C, top_height, top_width); its gradient is ignored, as in the fork
    Fork: src/caffe/layers/downsample_layer.cu
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({0, 1})
    same = slice(0, 0)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.check_maps(bottom_shapes)
        p, shape = value(self.param, "downsample_param"), bottom_shapes[0]
        size = (p.top_height, p.top_width) if len(bottom_shapes) == 1 else bottom_shapes[1][2:]
        if any(to != side and to < 2 for to, side in zip(size, shape[2:], strict=True)):
            raise self.error(
                f"found a top of {size[0]} x {size[1]} pixels, expected at least 2 x 2", "downsample_param"
            )
        return [(*shape[:2], *size)]

    def forward(self, maps: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
        maps = maps.detach()
        if maps.shape == self.top_shapes[0]:
            return maps.clone()
        over = [_near(side, to).to(maps) for side, to in zip(maps.shape[2:], self.top_shapes[0][2:], strict=True)]
        missing = maps.isnan()
        total, counted, left_out = (
            over[0] @ each @ over[1].t() for each in (maps.nan_to_num(0), (~missing).to(maps), missing.to(maps))
        )
        return torch.where(left_out / counted > 0.5, torch.nan, total / counted)


def _near(side: int, to: int) -> torch.Tensor:
    """Return the weight of each of ``side`` pixels for each of ``to``."""
    step = (side - 1) / max(to - 1, 1)
    places = torch.arange(to).unsqueeze(1) * step
    return (1 - (torch.arange(side) - places).abs() / step).clamp(min=0) if step else torch.eye(to, side)


@register("L1Loss", "l1_loss_param")
class L1Loss(Layer):
    """Sum of the absolute differences, divided by the number of images; NaN pixels are ignored.

    l2_per_location: sum over the pixels of sqrt(sum of squares over the channels + epsilon). plateau: smaller values
    are 0. normalize_by_num_entries: divided by the number of values that are not NaN, by channel.
    l2_prescale_by_channels: the mean of squares instead of the sum. If the difference is 0, the gradient is -1.

    bottom[0]  (N, C, H, W)
    bottom[1]  optional: subtracted from bottom[0], the same shape
    top[0]     the loss, ()
    Fork: src/caffe/layers/l1loss_layer.cu
    """

    bottoms, is_loss = (1, 2), True
    not_exported = "it is for training"

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if bottom_shapes[-1] != bottom_shapes[0]:
            raise self.error(f"found bottoms of shapes {bottom_shapes}, expected two of one shape", "bottom", 1)
        return [()]

    def forward(self, x: torch.Tensor, *others: torch.Tensor) -> torch.Tensor:
        p, difference = value(self.param, "l1_loss_param"), x - others[0] if others else x
        counts = ~difference.isnan()
        channels = x.shape[1] if x.dim() > 1 else 1
        divisor = counts.sum() / channels if p.normalize_by_num_entries else len(x)
        if p.l2_per_location:
            squares = difference.where(counts, 0).square().sum(1)
            squares = squares / channels if p.l2_prescale_by_channels else squares
            squares = squares.where(squares.detach() >= p.plateau**2, 0) if p.plateau > 0 else squares
            return (squares + p.epsilon).sqrt().sum() / divisor
        if p.plateau > 0:
            counts &= difference.detach().abs() >= p.plateau
        sign = torch.where(difference.detach() > 0, 1.0, -1.0).to(x)
        return (difference.where(counts, 0) * sign).sum() / divisor


@register("NegReLU", "relu_param")
class NegReLU(Activation):
    """min(x, 0) + negative_slope max(x, 0); the gradient at 0 is that of the positive side.

    bottom[0]  any shape
    top[0]     the same shape
    Fork: src/caffe/layers/neg_relu_layer.cpp
    """

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return torch.where(data < 0, data, data * self.param.relu_param.negative_slope)


@register("Mean", "mean_param")
class Mean(Layer):
    """output_scale (input_scale x + mean_scale mean); with operation: SUBTRACT, minus the mean.

    bottom[i]  (N, C, H, W)
    top[i]     the same shape; the mean is one value per channel, in turn, or the contents of ``file``
    Fork: src/caffe/layers/mean_layer.cpp
    """

    bottoms = tops = (1, None)

    def setup(self) -> None:
        p, where = value(self.param, "mean_param"), self.context.at("mean_param", "file")
        if not p.HasField("operation") or not (p.value or p.HasField("file")):
            raise self.error("expected an operation, ADD or SUBTRACT, and a file or values", "mean_param")
        numbers = torch.tensor(p.value).view(1, -1, 1, 1)
        if p.HasField("file"):
            numbers = torch.from_numpy(read_mean(p.file, where)).float().unsqueeze(0)
        self.numbers = numbers * p.mean_scale * (-1 if p.operation == SUBTRACTED else 1)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if self.num_tops != len(bottom_shapes):
            raise self.error(f"found {self.num_tops} top(s), expected one for each bottom, {len(bottom_shapes)}", "top")
        _, channels, *size = self.numbers.shape
        for i, shape in enumerate(bottom_shapes):
            if (
                len(shape) != 4
                or shape[1] % channels
                or list(shape[2:]) != (size if size != [1, 1] else list(shape[2:]))
            ):
                raise self.error(f"found a bottom of shape {shape} for a mean of {channels} x {size}", "bottom", i)
        return bottom_shapes

    def forward(self, *maps: torch.Tensor) -> tuple[torch.Tensor, ...]:
        p, numbers = value(self.param, "mean_param"), self.numbers.to(maps[0])
        times = [x.shape[1] // numbers.shape[1] for x in maps]
        return tuple(
            p.output_scale * (p.input_scale * x + numbers.repeat(1, n, 1, 1)) for x, n in zip(maps, times, strict=True)
        )
