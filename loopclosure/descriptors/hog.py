"""Histograms of oriented gradients: of a whole image, and CoHOG's regions.

HOG: Dalal and Triggs, CVPR 2005. CoHOG: Zaffar, Ehsan, Milford and McDonald-Maier, RA-L 2020, which describes an image
by overlapping regions and compares only those with texture. What follows has the paper's regions, bins and comparison;
its entropy is that of the gray values of each region, and the image is smaller than the paper's 512 x 512 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopclosure.errors import InputError
from loopclosure.places.frames import gray
from netspec.files.opencv import cv2

# Levels of gray whose histogram gives the entropy of a region; its greatest value is their logarithm.
ENTROPY_LEVELS = 32


@dataclass(frozen=True)
class Hog:
    """Blocks of 2 x 2 cells of gradient histograms of a gray image.

    side  the image is resized to this many pixels in both directions, a multiple of ``cell``
    cell  side of a cell in pixels
    bins  directions over 180 degrees
    """

    side: int = 256
    cell: int = 16
    bins: int = 9

    def __post_init__(self) -> None:
        if self.cell < 2 or self.bins < 2 or self.side < 2 * self.cell or self.side % self.cell:
            raise InputError(
                f"HOG of {self.side} pixels with cells of {self.cell} and {self.bins} bins; expected at least 2 x 2 "
                "whole cells and 2 bins"
            )

    def blocks(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the blocks of an image (H, W) or (H, W, 3), each of unit length: (n - 1, n - 1, 4 bins), n cells."""
        small = self._resized(image).astype(np.float32)
        across = cv2.Sobel(small, cv2.CV_32F, 1, 0, ksize=1)
        down = cv2.Sobel(small, cv2.CV_32F, 0, 1, ksize=1)
        strength = np.hypot(across, down)
        direction = np.arctan2(down, across) % np.pi / np.pi * self.bins - 0.5
        low = np.floor(direction)
        share = direction - low
        cells = self.side // self.cell
        histogram = np.zeros((cells, cells, self.bins), np.float32)
        for bin_, weight in ((low, 1 - share), (low + 1, share)):  # each gradient is shared by two bins
            for number in range(self.bins):
                here = np.where(bin_ % self.bins == number, strength * weight, 0)
                histogram[..., number] += here.reshape(cells, self.cell, cells, self.cell).sum(axis=(1, 3))
        block = np.concatenate([histogram[:-1, :-1], histogram[:-1, 1:], histogram[1:, :-1], histogram[1:, 1:]], axis=2)
        length = np.linalg.norm(block, axis=2, keepdims=True)
        return np.divide(block, length, out=np.zeros_like(block), where=length > 0)

    def entropies(self, image: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Return the entropy of the gray values of each block, as a share of the greatest: (n - 1, n - 1)."""
        levels = self._resized(image) // (256 // ENTROPY_LEVELS)
        cells = self.side // self.cell
        count = np.stack(
            [(levels == v).reshape(cells, self.cell, cells, self.cell).sum(axis=(1, 3)) for v in range(ENTROPY_LEVELS)],
            axis=2,
        )
        count = count[:-1, :-1] + count[:-1, 1:] + count[1:, :-1] + count[1:, 1:]
        share = count / (4.0 * self.cell**2)
        return -(share * np.log(np.where(share > 0, share, 1))).sum(axis=2) / np.log(ENTROPY_LEVELS)

    def _resized(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        resized = cv2.resize(gray(image), (self.side, self.side), interpolation=cv2.INTER_AREA)
        return np.asarray(resized, np.uint8)
