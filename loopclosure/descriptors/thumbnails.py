"""Gray thumbnails compared pixel by pixel: the simplest baseline, and the input of SeqSLAM."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from loopclosure.errors import InputError
from loopclosure.places.frames import gray
from netspec.files.opencv import cv2

# Standard deviation in gray values below which a patch counts as uniform; rounding can make it slightly positive.
UNIFORM = 1e-6
NORMALIZATIONS = ("image", "patch", "none")


@dataclass(frozen=True)
class Thumbnailer:
    """Reduces an image to a gray thumbnail.

    width, height  of the thumbnail in pixels
    normalize      "image": zero mean, unit deviation; "patch": the same for each patch (SeqSLAM); "none": gray values
    patch          side of a patch in pixels
    """

    width: int = 32
    height: int = 24
    normalize: str = "image"
    patch: int = 8

    def __post_init__(self) -> None:
        if self.normalize not in NORMALIZATIONS:
            raise InputError(f'unknown normalization "{self.normalize}"; known: {", ".join(NORMALIZATIONS)}')
        if min(self.width, self.height, self.patch) < 1:
            raise InputError(f"a thumbnail of {self.width}x{self.height} in patches of {self.patch} has no pixels")
        if self.normalize == "patch" and (self.width % self.patch or self.height % self.patch):
            raise InputError(f"{self.width}x{self.height} pixels cannot be divided into patches of {self.patch}")

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the thumbnail (height, width) float32 of an (H, W) or (H, W, 3) uint8 image."""
        # INTER_AREA averages all pixels; bilinear interpolation uses only four and causes aliasing.
        small = cv2.resize(gray(image), (self.width, self.height), interpolation=cv2.INTER_AREA).astype(np.float32)
        if self.normalize == "none":
            return small
        return normalize_patches(small, self.patch if self.normalize == "patch" else 0)


def normalize_patches(image: np.ndarray, patch: int = 0) -> np.ndarray:
    """Return (image - mean) / standard deviation for each patch, with n - 1; 0 if a patch is uniform.

    image  (H, W)
    patch  side of a patch in pixels; H and W must be multiples of it; 0: the whole image is one patch
    """
    height, width = image.shape
    rows, columns = (patch, patch) if patch else (height, width)
    tiles = image.astype(np.float64).reshape(height // rows, rows, width // columns, columns)
    centered = tiles - tiles.mean(axis=(1, 3), keepdims=True)
    deviation = np.sqrt((centered**2).sum(axis=(1, 3), keepdims=True) / max(rows * columns - 1, 1))
    normalized = np.divide(centered, deviation, out=np.zeros_like(centered), where=deviation > UNIFORM)
    return normalized.reshape(height, width).astype(np.float32)


def differences(queries: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference per pixel (Q, R) of thumbnails (Q, h, w) and (R, h, w)."""
    a, b = queries.reshape(len(queries), -1), references.reshape(len(references), -1)
    return cdist(a, b, "cityblock") / a.shape[1]


# Gray levels of the histogram for the entropy of a region; the maximum of the entropy is their logarithm.
ENTROPY_LEVELS = 32


@dataclass(frozen=True)
class Hog:
    """Histograms of oriented gradients of a gray image, in blocks of 2 x 2 cells.

    side  the image is resized to this many pixels in both directions; a multiple of ``cell``
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
        for bin_, weight in ((low, 1 - share), (low + 1, share)):  # each gradient is split between two bins
            for number in range(self.bins):
                here = np.where(bin_ % self.bins == number, strength * weight, 0)
                histogram[..., number] += here.reshape(cells, self.cell, cells, self.cell).sum(axis=(1, 3))
        block = np.concatenate([histogram[:-1, :-1], histogram[:-1, 1:], histogram[1:, :-1], histogram[1:, 1:]], axis=2)
        length = np.linalg.norm(block, axis=2, keepdims=True)
        return np.divide(block, length, out=np.zeros_like(block), where=length > 0)

    def entropies(self, image: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Return the entropy of the gray values of each block over its maximum: (n - 1, n - 1)."""
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
