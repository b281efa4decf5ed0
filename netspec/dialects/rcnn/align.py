"""ROIAlign, which pools regions by interpolating between pixels. Two forks interpolate at different points."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from netspec.dialects.checks import check_at_least_1
from netspec.dialects.rcnn.regions import RegionPooling
from netspec.layers.contract.base import Shape
from netspec.proto.schema import given_fields, has, value

CASCADE, ALIGN = "roi_pooling_param", "roi_align_param"


class ROIAlign(RegionPooling):
    """Pool each region of a map, with bilinear interpolation between pixels.

    With pad_ratio in roi_pooling_param it is the layer of Cascade R-CNN. A region grows on each side by pad_ratio times
    its length. It is read at (pooled_h + 1) x (pooled_w + 1) points, the corners of its bins. A Pooling layer then
    takes their means. Points outside the map are 0, and so is a region that ends before it begins. Otherwise it is the
    layer of Detectron: the mean of sampling_ratio^2 points in each bin. Without sampling_ratio, each side of a bin has
    a point for each of its pixels. A region is at least one pixel long.

    bottom[0]  the map (N, C, H, W)
    bottom[1]  regions (R, 5): image, x1, y1, x2, y2; gets no gradient
    top[0]     (R, C, pooled_h, pooled_w); Cascade R-CNN's (R, C, pooled_h + 1, pooled_w + 1)
    Fork: zhaoweicai/mscnn, src/caffe/layers/roi_align_layer.cu; Detectron's roi_align_op, in Caffe forks with
    roi_align_param
    """

    not_exported = "PyTorch has no reading of regions; torchvision's roi_align is near to it"

    def setup(self) -> None:
        group = CASCADE if CASCADE in given_fields(self.param) else ALIGN
        param = value(self.param, group)
        check_at_least_1(self, group, "pooled_h", "pooled_w")
        self.bins, self.scale = (param.pooled_h, param.pooled_w), float(param.spatial_scale)
        self.cascade = group == CASCADE and has(param, "pad_ratio")
        self.pad_ratio = float(param.pad_ratio) if self.cascade else 0.0
        self.samples = int(param.sampling_ratio) if group == ALIGN else -1

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return [(self.check_regions(bottom_shapes), bottom_shapes[0][1], *(n + self.cascade for n in self.bins))]

    def forward(self, maps: torch.Tensor, regions: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            regions = self.rows(regions)
            image = self.images_of(regions, maps.shape[0])
            weigh = self._corners if self.cascade else self._means
            columns, rows = (
                weigh(regions[:, 1 + k], regions[:, 3 + k], self.bins[1 - k], maps.shape[3 - k]).to(maps)
                for k in (0, 1)
            )
            if self.cascade:  # a region is empty if one of its sides is empty empty
                rows = rows * (self._lengths(regions).amin(1) > 0)[:, None, None]
        top = maps.new_zeros(self.top_shapes[0])
        for i in image.unique().tolist():
            own = image == i
            by_row = torch.einsum("rph,chw->rcpw", rows[own], maps[i])
            top = top.index_put((own,), torch.einsum("rqw,rcpw->rcpq", columns[own], by_row))
        return top

    def _lengths(self, regions: torch.Tensor) -> torch.Tensor:
        """Return the lengths of Cascade R-CNN's regions, enlarged and scaled: (R, 2)."""
        sizes = regions[:, 3:] - regions[:, 1:3]
        return (sizes + 2 * (sizes + 1) * self.pad_ratio) * self.scale

    def _corners(self, first: torch.Tensor, last: torch.Tensor, bins: int, size: int) -> torch.Tensor:
        """Return the weights of an axis' pixels in the corners of the bins: (R, bins + 1, size)."""
        pad = (last - first + 1) * self.pad_ratio
        start, end = (first - pad) * self.scale - 0.5, (last + pad) * self.scale - 0.5
        steps = torch.arange(bins + 1, dtype=first.dtype, device=first.device) * ((end - start) / bins)[:, None]
        at = start[:, None] + steps
        return between(at, size) * ((at >= -0.5) & (at <= size - 0.5))[..., None]

    def _means(self, first: torch.Tensor, last: torch.Tensor, bins: int, size: int) -> torch.Tensor:
        """Return the weights of an axis' pixels in the means of the bins: (R, bins, size)."""
        start = first * self.scale
        length = (last * self.scale - start).clamp(min=1)
        counts = (length / bins).ceil() if self.samples < 1 else torch.full_like(length, self.samples)
        index = torch.arange(int(counts.max()) if len(counts) else 0, dtype=first.dtype, device=first.device)
        inside = (index + 0.5) / counts[:, None]  # of a bin
        bin_index = torch.arange(bins, dtype=first.dtype, device=first.device)
        at = start[:, None, None] + (bin_index[:, None] + inside[:, None]) * (length / bins)[:, None, None]
        counted = (index < counts[:, None])[:, None] & (at >= -1) & (at <= size)
        return (between(at, size) * counted[..., None]).sum(2) / counts[:, None, None]


def between(at: torch.Tensor, size: int) -> torch.Tensor:
    """Return the weights of an axis' pixels in values at positions (...), clamped to the map: (..., size)."""
    pixels = torch.arange(size, dtype=at.dtype, device=at.device)
    return (1 - (at.clamp(0, size - 1)[..., None] - pixels).abs()).clamp(min=0)
