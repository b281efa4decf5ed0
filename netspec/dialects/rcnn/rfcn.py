"""R-FCN: position-sensitive pooling, and online hard example mining (OHEM).

Fork: daijifeng001/caffe-rfcn; for the losses on a CPU, Intel's caffe
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from typing_extensions import override

from netspec.dialects.boxes import as_array, highest
from netspec.dialects.checks import check_at_least_1
from netspec.dialects.layers import replace
from netspec.dialects.rcnn.regions import RegionPooling, whole
from netspec.dialects.rcnn.smooth import NORMALIZED, SmoothL1LossOHEM, divisor, four
from netspec.dialects.registry import added_value
from netspec.layers import Layer, register
from netspec.layers.contract.base import Shape
from netspec.layers.loss.scores import SoftmaxWithLoss
from netspec.proto.schema import value

DECLARATIONS = """
message PSROIPoolingParameter {
  required float spatial_scale = 1;
  required int32 output_dim = 2;
  required int32 group_size = 3;
}
message BoxAnnotatorOHEMParameter {
  required uint32 roi_per_img = 1;
  optional int32 ignore_label = 2 [default = -1];
}
enum NormalizationMode { PRE_FIXED = 4; }
extend LossParameter {
  optional NormalizationMode normalization = 1014;
  optional float pre_fixed_normalizer = 1015 [default = 1];
}
extend LayerParameter {
  optional BoxAnnotatorOHEMParameter box_annotator_ohem_param = 10000;
  optional PSROIPoolingParameter psroi_pooling_param = 10001;
}
"""


@register("PSROIPooling", "psroi_pooling_param")
class PSROIPooling(RegionPooling):
    """Divide each region of a map into g x g bins and return the mean of each, from a separate channel for each bin.

    Channel d of the top at row i and column j of the bins is the mean of channel (d g + i) g + j of the map, where g is
    group_size. A region's corners are rounded to pixels of the image, both included, then scaled by spatial_scale; a
    bin has all pixels that it touches, and is 0 if there are none.

    bottom[0]  the map (N, output_dim g g, H, W)
    bottom[1]  regions (R, 5): image, x1, y1, x2, y2; gets no gradient
    top[0]     (R, output_dim, g, g)
    Fork: daijifeng001/caffe-rfcn, src/caffe/layers/psroi_pooling_layer.cpp
    """

    not_exported = "there is no position-sensitive pooling of regions"

    def setup(self) -> None:
        param = value(self.param, "psroi_pooling_param")
        check_at_least_1(self, "psroi_pooling_param", "output_dim", "group_size")
        self.channels, self.bins, self.scale = param.output_dim, param.group_size, param.spatial_scale

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the bins of all regions; the map must have a channel for each bin."""
        regions = self.check_regions(bottom_shapes)
        expected = self.channels * self.bins * self.bins
        if bottom_shapes[0][1] != expected:
            message = f"found {bottom_shapes[0][1]} channels, expected output_dim group_size^2 = {expected}"
            raise self.error(message, "bottom", 0)
        return [(regions, self.channels, self.bins, self.bins)]

    def forward(self, maps: torch.Tensor, regions: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            regions = self.rows(regions)
            image = self.images_of(regions, maps.shape[0])
            corners = whole(regions[:, 1:])
            columns = self._inside(corners[:, 0], corners[:, 2], maps.shape[3])
            rows = self._inside(corners[:, 1], corners[:, 3], maps.shape[2])
            areas = rows.sum(2)[:, :, None] * columns.sum(2)[:, None, :]
            rows, columns = rows.to(maps), columns.to(maps)
        grouped = maps.unflatten(1, (self.channels, self.bins, self.bins))
        sums = maps.new_zeros(self.top_shapes[0])
        for i in image.unique().tolist():
            own = image == i
            by_row = torch.einsum("rqw,cpqhw->rcpqh", columns[own], grouped[i])
            sums = sums.index_put((own,), torch.einsum("rph,rcpqh->rcpq", rows[own], by_row))
        return sums / areas.clamp(min=1)[:, None]

    def _inside(self, first: torch.Tensor, last: torch.Tensor, size: int) -> torch.Tensor:
        """Return 1 for pixels of the map that a bin touches along one axis, else 0: (R, bins, size)."""
        start = first * self.scale
        length = ((last + 1) * self.scale - start).clamp(min=0.1)
        steps = torch.arange(self.bins + 1, dtype=first.dtype, device=first.device) * (length / self.bins)[:, None]
        ends = steps + start[:, None]
        pixels = torch.arange(size, dtype=first.dtype, device=first.device)
        return ((pixels >= ends[:, :-1, None].floor()) & (pixels < ends[:, 1:, None].ceil())).to(first.dtype)


@register("SoftmaxWithLossOHEM", "softmax_param", *NORMALIZED)
class SoftmaxWithLossOHEM(SoftmaxWithLoss):
    """Caffe's SoftmaxWithLoss, which also returns the loss of each prediction, or 0 if it is ignored.

    With normalization: PRE_FIXED, the sum is divided by pre_fixed_normalizer.

    bottom[0]  scores (N, C, ...), C at softmax_param.axis
    bottom[1]  labels, one per prediction
    top[0]     the loss, ()
    top[1]     optional: the softmax, in bottom[0]'s shape; the gradients of top[1] and top[2] are ignored
    top[2]     optional: the loss of each prediction, bottom[1]'s shape
    Fork: intel/caffe, src/caffe/layers/softmax_loss_ohem_layer.cpp
    """

    tops = (1, 3)
    not_exported = "it is for training"

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return [*super().reshape(bottom_shapes), bottom_shapes[1]][: self.num_tops]

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        tops = super().forward(scores, labels)
        return (*tops, self._losses.reshape(labels.shape))[: self.num_tops]

    @override
    def sum_up(
        self, losses: torch.Tensor, valid: torch.Tensor | None, total: Callable[[torch.Tensor], torch.Tensor]
    ) -> torch.Tensor:
        if valid is not None:
            losses = losses.where(valid, 0)
        self._losses = losses.detach()
        return total(losses) / divisor(self, self.outer, self.inner, valid)


replace(
    "SoftmaxWithLoss",
    "softmax_param",
    *NORMALIZED,
    where=lambda param: len(param.top) > 2 or added_value(param.loss_param, "normalization") == "PRE_FIXED",
)(type("SoftmaxWithLoss", (SoftmaxWithLossOHEM,), {"__doc__": SoftmaxWithLossOHEM.__doc__}))
register("SmoothL1LossOHEM", *NORMALIZED)(SmoothL1LossOHEM)


@register("BoxAnnotatorOHEM", "box_annotator_ohem_param")
class BoxAnnotatorOHEM(Layer):
    """Keep the labels and weights of the roi_per_img regions with the largest loss in each image; remove the others'.

    Equal losses are in the order of the fork's std::sort.

    bottom[0]  regions (R, 5) or (R, 5, 1, 1): image, x1, y1, x2, y2
    bottom[1]  the loss of each (R, 1, 1, 1)
    bottom[2]  labels (R,)
    bottom[3]  weights (R, C)
    top[0]     labels (R, 1, 1, 1): ignore_label for a region that was not chosen
    top[1]     weights (R, C, 1, 1): 0 for a region that was not chosen
    Fork: daijifeng001/caffe-rfcn, src/caffe/layers/box_annotator_ohem_layer.cu
    """

    bottoms, tops = (4, 4), (2, 2)
    label_bottoms = frozenset(range(4))
    not_exported = "it is for training"

    def setup(self) -> None:
        self.settings = value(self.param, "box_annotator_ohem_param")
        check_at_least_1(self, "box_annotator_ohem_param", "roi_per_img")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        full = [four(shape) for shape in bottom_shapes]
        (count, five, *pixels), *others = full
        for i, (shape, channels) in enumerate(zip(full, (5, 1, 1, full[3][1]), strict=True)):
            if five != 5 or pixels != [1, 1] or shape != (count, channels, 1, 1):
                raise self.error(f"found shape {bottom_shapes[i]}, expected ({count}, {channels})", "bottom", i)
        return [(count, 1, 1, 1), (count, others[2][1], 1, 1)]

    def forward(
        self, regions: torch.Tensor, losses: torch.Tensor, labels: torch.Tensor, weights: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        image = regions.reshape(len(regions), 5)[:, 0].long()
        order = torch.from_numpy(highest(as_array(losses).reshape(-1), len(regions))).to(image.device)
        chosen = torch.zeros(len(regions), 1, dtype=torch.bool, device=image.device)
        for i in image.unique().tolist():
            chosen[order[image[order] == i][: self.settings.roi_per_img]] = True
        kept = torch.where(chosen, labels.reshape(-1, 1), self.settings.ignore_label)
        return kept.reshape(-1, 1, 1, 1), (weights.reshape(len(regions), -1) * chosen)[:, :, None, None]
