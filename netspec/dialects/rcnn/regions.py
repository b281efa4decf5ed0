"""The base of layers that pool the part of a map that each region covers."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from netspec.errors import SpecError
from netspec.layers.contract.base import Layer, Shape


class RegionPooling(Layer):
    """Base of layers that pool the part of a map that a region of the image covers."""

    bottoms = (2, 2)

    def check_regions(self, bottom_shapes: Sequence[Shape]) -> int:
        """Return the number of regions; raise SpecError if the bottoms are not a map and regions."""
        maps, regions = bottom_shapes
        if len(maps) != 4:
            raise self.error(f"found a map of shape {maps}, expected 4 axes (N, C, H, W)", "bottom", 0)
        if regions[1:] not in ((5,), (5, 1, 1), (4,)):  # scripts reshape (R, 4) before they run the net
            raise self._wrong(regions)
        return regions[0]

    def _wrong(self, regions: Shape) -> SpecError:
        return self.error(f"found regions of shape {regions}, expected (R, 5): image, x1, y1, x2, y2", "bottom", 1)

    def rows(self, regions: torch.Tensor) -> torch.Tensor:
        """Return the regions as (R, 5). Raises SpecError for a placeholder that was not reshaped."""
        if regions.shape[1] != 5:
            raise self._wrong(tuple(regions.shape))
        return regions.reshape(-1, 5)

    def images_of(self, regions: torch.Tensor, images: int) -> torch.Tensor:
        """Return the image that each region (R, 5) is in; raise SpecError for one that is not in the batch."""
        image = regions[:, 0].long()
        wrong = image[(image < 0) | (image >= images)]
        if len(wrong):
            raise self.error(f"found a region in image {wrong[0]}, expected 0 to {images - 1}", "bottom", 1)
        return image


def whole(x: torch.Tensor) -> torch.Tensor:
    """Round to integers, halves away from zero, like C's round."""
    whole = x.trunc()
    return whole + x.sign() * ((x - whole).abs() >= 0.5)
