"""Gray thumbnails compared pixel by pixel: the simplest baseline, and the input of SeqSLAM."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
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
