"""Fast and Faster R-CNN: rbgirshick/caffe-fast-rcnn; R-FCN's layers are in rfcn.py.

It also has the Python layers of py-faster-rcnn, by module and class. If ``--allow-python-layers`` is given and
their module can be imported, the module's code runs instead.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from functools import reduce

import numpy as np
import torch

from netspec.dialects.boxes import as_array
from netspec.dialects.checks import check_at_least_1
from netspec.dialects.rcnn.align import ROIAlign
from netspec.dialects.rcnn.faster import AnchorTarget, ProposalTarget, RoIData, anchors_of, settings
from netspec.dialects.rcnn.proposals import all_anchors, base_anchors, half_up, moved, suppress
from netspec.dialects.rcnn.regions import RegionPooling, whole
from netspec.dialects.rcnn.smooth import NORMALIZED, SmoothL1Loss
from netspec.layers import Layer, register
from netspec.layers.contract.base import ALL_AXES, Shape
from netspec.proto.schema import TRAIN, value

DECLARATIONS = """
message ROIPoolingParameter {
  optional uint32 pooled_h = 1 [default = 0];
  optional uint32 pooled_w = 2 [default = 0];
  optional float spatial_scale = 3 [default = 1];
  // MSCNN
  optional float pad_ratio = 4 [default = 0];
}
message ROIAlignParameter {
  optional uint32 pooled_h = 1 [default = 0];
  optional uint32 pooled_w = 2 [default = 0];
  optional float spatial_scale = 3 [default = 1];
  optional int32 sampling_ratio = 4 [default = -1];
}
message SmoothL1LossParameter {
  optional float sigma = 1 [default = 1];
}
message ProposalParameter {
  optional uint32 feat_stride = 1 [default = 16];
  optional uint32 base_size = 2 [default = 16];
  optional uint32 min_size = 3 [default = 16];
  repeated float ratio = 4;
  repeated float scale = 5;
  optional uint32 pre_nms_topn = 6 [default = 6000];
  optional uint32 post_nms_topn = 7 [default = 300];
  optional float nms_thresh = 8 [default = 0.7];
}
extend LayerParameter {
  optional ProposalParameter proposal_param = 10002;
  optional ROIPoolingParameter roi_pooling_param = 8266711;
  optional SmoothL1LossParameter smooth_l1_loss_param = 8266712;
  optional ROIAlignParameter roi_align_param = 8266713;
}
"""


@register("ROIPooling", "roi_pooling_param")
class ROIPooling(RegionPooling):
    """Divide each region of a map into pooled_h x pooled_w bins and return the maximum of each.

    With pad_ratio (MSCNN), a region is first enlarged on each side by this share of its length. Its corners are scaled
    by spatial_scale and rounded to pixels, both included. The first of equal pixels gets the gradient; a bin without a
    pixel is 0. A region with x2 < x1 or y2 < y1 is one pixel, without a gradient.

    bottom[0]  the map (N, C, H, W)
    bottom[1]  regions (R, 5): image, x1, y1, x2, y2; gets no gradient
    top[0]     (R, C, pooled_h, pooled_w)
    Fork: rbgirshick/caffe-fast-rcnn, src/caffe/layers/roi_pooling_layer.cpp
    """

    not_exported = "PyTorch has no pooling of regions; torchvision's roi_pool is near to it"

    def setup(self) -> None:
        param = value(self.param, "roi_pooling_param")
        check_at_least_1(self, "roi_pooling_param", "pooled_h", "pooled_w")
        self.bins = (param.pooled_h, param.pooled_w)
        self.scale: float = param.spatial_scale
        self.pad_ratio: float = param.pad_ratio

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return [(self.check_regions(bottom_shapes), bottom_shapes[0][1], *self.bins)]

    def forward(self, maps: torch.Tensor, regions: torch.Tensor) -> torch.Tensor:
        images, channels, height, width = maps.shape
        with torch.no_grad():
            regions = self.rows(regions)
            image = self.images_of(regions, images)
            first, last = regions[:, 1:3], regions[:, 3:]
            pad = (last - first + 1) * self.pad_ratio
            corners = whole(torch.cat([first - pad, last + pad], dim=1) * self.scale)
            rows = self._bins(corners[:, 1], corners[:, 3], self.bins[0], height)[:, :, None]
            columns = self._bins(corners[:, 0], corners[:, 2], self.bins[1], width)[:, None]
            windows = torch.cat(torch.broadcast_tensors(rows, columns), dim=3)
            pixel = torch.empty((*windows.shape[:3], channels), dtype=torch.int32, device=maps.device)
            for i in image.unique().tolist():
                own = image == i
                pixel[own] = _first_maxima(maps[i], windows[own].reshape(-1, 4)).reshape(-1, *pixel.shape[1:])
            pixel = pixel.permute(0, 3, 1, 2)
            plane = image[:, None] * channels + torch.arange(channels, device=maps.device)
            index = plane[:, :, None, None] * (height * width) + pixel.clamp(min=0)
            inverted = (corners[:, 2:] < corners[:, :2]).any(1)[:, None, None, None]
        top = maps.reshape(-1)[index].where(pixel >= 0, 0)
        return torch.where(inverted, top.detach(), top)

    @staticmethod
    def _bins(first: torch.Tensor, last: torch.Tensor, count: int, size: int) -> torch.Tensor:
        """Return the begin and end of each region's bins along one axis, in pixels of the map: (R, count, 2)."""
        length = (last - first + 1).clamp(min=1)
        steps = torch.arange(count + 1, dtype=first.dtype, device=first.device) * (length / count)[:, None]
        ends = torch.stack([steps[:, :-1].floor(), steps[:, 1:].ceil()], dim=2) + first[:, None, None]
        return ends.clamp(0, size).long()


Table = tuple[torch.Tensor, torch.Tensor]  # values and their pixels


def _first_maxima(maps: torch.Tensor, windows: torch.Tensor) -> torch.Tensor:
    """Return the pixel, row * width + column, of the first maximum of each window of maps (C, H, W): (n, C).

    Windows (n, 4) are begin and end of their rows, begin and end of their columns; an empty one gives -1. Each is
    covered by four possibly overlapping windows whose sides are powers of two; their maxima are computed by doubling.
    """
    height, width = maps.shape[1:]
    sides = windows[:, 1::2] - windows[:, ::2]
    doublings = sides.clamp(min=1).log2().long().masked_fill((sides < 1).any(dim=1, keepdim=True), -1)
    most_down, most_across = doublings.amax(dim=0).tolist() if len(windows) else (-1, -1)
    found = torch.full((len(windows), maps.shape[0]), -1, dtype=torch.int32, device=maps.device)
    values = maps.permute(1, 2, 0).contiguous()
    pixels = torch.arange(height * width, dtype=found.dtype, device=maps.device)
    pixels = pixels.reshape(height, width, 1).expand_as(values)
    tall = values, pixels
    for down in range(most_down + 1):
        tall = tall if down == 0 else _doubled(tall, 0, 1 << down - 1)
        table = tall
        for across in range(most_across + 1):
            table = table if across == 0 else _doubled(table, 1, 1 << across - 1)
            own = (doublings[:, 0] == down) & (doublings[:, 1] == across)
            upper, lower, left, right = windows[own].unbind(dim=1)
            corners = [(y, x) for y in (upper, lower - (1 << down)) for x in (left, right - (1 << across))]
            parts = [(table[0][corner], table[1][corner]) for corner in corners]
            found[own] = reduce(_first_of, parts)[1]
    return found


def _doubled(table: Table, axis: int, side: int) -> Table:
    """Return the first maxima of windows of twice the size along an axis."""
    count = table[0].shape[axis] - side
    values, pixels = ([part.narrow(axis, start, count) for start in (0, side)] for part in table)
    return _first_of((values[0], pixels[0]), (values[1], pixels[1]))


def _first_of(a: Table, b: Table) -> Table:
    """Return the larger values; of equal ones, that of the first pixel."""
    second = (b[0] > a[0]) | ((b[0] == a[0]) & (b[1] < a[1]))
    return torch.where(second, b[0], a[0]), torch.where(second, b[1], a[1])


@register("Proposal", "proposal_param")
class Proposal(Layer):
    """Propose regions: anchors moved by the predicted offsets, of which the best that do not overlap are kept.

    There is an anchor for each ``ratio`` (height / width; 0.5, 1, 2) and ``scale`` (8, 16, 32) of base_size pixels at
    every feat_stride pixels. From the pre_nms_topn boxes of highest score, those that overlap a better one by more than
    nms_thresh are removed, and at most post_nms_topn are kept. A box with a side below min_size times the image's scale
    has score 0. There may be fewer regions than in the declared shape of the top.

    bottom[0]  scores (1, 2 A, H, W): background, then object, of the A anchors
    bottom[1]  (1, 4 A, H, W): dx, dy, log dw, log dh of each anchor
    bottom[2]  (1, 3) or (1, 4): height, width, scale of the image, or its scales of height and width
    top[0]     regions (n, 5): 0, x1, y1, x2, y2
    top[1]     optional: their scores (n,)
    Fork: PVANet's and Intel's caffe, src/caffe/layers/proposal_layer.cpp
    """

    counted_axis = ALL_AXES  # there may be fewer
    bottoms = (3, 3)
    tops = (1, 2)
    label_bottoms = frozenset({0, 1, 2})
    drops_small = False  # boxes below min_size, instead of giving them score 0
    score_axes: Shape = ()  # further axes of top[1]

    def setup(self) -> None:
        """Compute the anchors of one pixel."""
        self.settings = param = value(self.param, "proposal_param")
        check_at_least_1(self, "proposal_param", "feat_stride", "base_size", "pre_nms_topn", "post_nms_topn")
        for name in ("ratio", "scale"):
            if any(number <= 0 for number in getattr(param, name)):
                raise self.error(f"{name} must be above 0", "proposal_param", name)
        self.anchors = base_anchors(param.base_size, param.ratio or (0.5, 1, 2), param.scale or (8, 16, 32), half_up)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        scores, deltas, image = bottom_shapes
        count = len(self.anchors)
        if len(scores) != 4 or scores[:2] != (1, 2 * count):
            raise self.error(f"found scores of shape {scores}, expected (1, {2 * count}, H, W)", "bottom", 0)
        if deltas != (1, 4 * count, *scores[2:]):
            expected = (1, 4 * count, *scores[2:])
            raise self.error(f"found boxes of shape {deltas}, expected {expected}", "bottom", 1)
        if image[:1] != (1,) or math.prod(image) not in (3, 4, 6):
            raise self.error(f"found an image's sizes of shape {image}, expected (1, 3), (1, 4) or (1, 6)", "bottom", 2)
        most = self.settings.post_nms_topn
        return [(most, 5), (most, *self.score_axes)][: self.num_tops]

    def forward(self, scores: torch.Tensor, deltas: torch.Tensor, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        param = self.settings
        count, (height, width) = len(self.anchors), scores.shape[2:]
        sizes = as_array(image).reshape(-1)
        anchors = all_anchors(self.anchors, param.feat_stride, height, width)
        moves = as_array(deltas)[0].reshape(count, 4, height, width).transpose(2, 3, 0, 1).reshape(-1, 4)
        boxes = moved(anchors, moves, sizes[0], sizes[1])
        least = param.min_size * sizes[[3 if len(sizes) == 4 else 2, 2]]  # of width and height
        large = (boxes[:, 2:] - boxes[:, :2] + 1 >= least).all(axis=1)
        found = as_array(scores)[0, count:].transpose(1, 2, 0).reshape(-1)
        found = found[large] if self.drops_small else np.where(large, found, np.float32(0))
        boxes = boxes[large] if self.drops_small else boxes
        order = np.argsort(-found, kind="stable")[: param.pre_nms_topn]
        order = order[suppress(boxes[order], param.nms_thresh, param.post_nms_topn)]
        regions = np.concatenate([np.zeros((len(order), 1), np.float32), boxes[order]], axis=1)
        tops = (torch.from_numpy(regions), torch.from_numpy(found[order].reshape(-1, *self.score_axes)))
        self.top_shapes = [tuple(top.shape) for top in tops[: self.num_tops]]
        return tuple(top.to(scores) for top in tops[: self.num_tops])


@register("rpn.proposal_layer.ProposalLayer", "python_param")
class ProposalLayer(Proposal):
    """Proposal with the settings of py-faster-rcnn. It replaces the Python layer rpn.proposal_layer.ProposalLayer.

    In training, 2000 of 12000 regions are kept, in testing 300 of 6000. Boxes below the minimum size are left out.
    param_str has feat_stride, scales, ratios.

    bottom[0]  scores (1, 2 A, H, W): background, then object, of the A anchors
    bottom[1]  (1, 4 A, H, W): dx, dy, log dw, log dh of each anchor
    bottom[2]  (1, 3): height, width, scale of the image
    top[0]     regions (n, 5): 0, x1, y1, x2, y2
    top[1]     optional: their scores (n, 1)
    Fork: rbgirshick/py-faster-rcnn, lib/rpn/proposal_layer.py
    """

    drops_small = True
    score_axes = (1,)

    def setup(self) -> None:
        found = settings(self, "feat_stride", "scales", "ratios")
        self.settings = param = copy.deepcopy(value(self.param, "proposal_param"))
        param.feat_stride = int(found["feat_stride"])
        param.pre_nms_topn, param.post_nms_topn = (12000, 2000) if self.phase == TRAIN else (6000, 300)
        self.anchors = anchors_of(found)


register("rpn.anchor_target_layer.AnchorTargetLayer", "python_param")(AnchorTarget)
register("rpn.proposal_target_layer.ProposalTargetLayer", "python_param")(ProposalTarget)
register("roi_data_layer.layer.RoIDataLayer", "python_param")(RoIData)
register("ROIAlign", "roi_pooling_param", "roi_align_param")(ROIAlign)
register("SmoothL1Loss", "smooth_l1_loss_param", *NORMALIZED)(SmoothL1Loss)
