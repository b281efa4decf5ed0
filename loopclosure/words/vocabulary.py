"""Visual words: local features of an image, the vocabulary that quantizes them, and counts of words.

A descriptor is a SIFT vector of unit length (with ``root``, RootSIFT: the square root of the L1-normalized histogram,
Arandjelovic and Zisserman, CVPR 2012), or the 256 bits of ORB as floats. An image without features has no words; it
is still a place.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.cluster.vq import kmeans2

from loopclosure.descriptors.similarity import squared_distances
from loopclosure.errors import InputError
from loopclosure.places.frames import gray
from netspec.files.opencv import cv2

# Rows processed at a time when all distances to the centers are needed: 4096 x 5000 words need 80 MB.
BLOCK_ROWS = 4096
ITERATIONS = 10  # of k-means: with 20, the squared distances to the words are 0.1 % smaller
KINDS = {"sift": 128, "orb": 256}


@lru_cache(maxsize=8)
def _detector(kind: str, max_features: int, contrast: float) -> Any:
    if kind == "orb":
        return cv2.ORB_create(nfeatures=max_features)  # pyright: ignore[reportAttributeAccessIssue]
    sift = cv2.SIFT_create  # pyright: ignore[reportAttributeAccessIssue]
    return sift(nfeatures=max_features, contrastThreshold=contrast)


@dataclass(frozen=True)
class Extractor:
    """Local features of a gray image.

    kind          "sift" or "orb"
    max_features  number of strongest features kept per image
    root          RootSIFT instead of SIFT
    contrast      SIFT's contrast threshold (OpenCV's default); a lower value finds more in images of low contrast
    """

    kind: str = "sift"
    max_features: int = 400
    root: bool = True
    contrast: float = 0.04

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f'unknown kind of features "{self.kind}"; known: {", ".join(KINDS)}')
        if self.max_features < 1:
            raise InputError(f"max_features is {self.max_features}; at least one feature per image is needed")

    @property
    def size(self) -> int:
        """Length of a descriptor."""
        return KINDS[self.kind]

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the descriptors (n, size) float32 of an (H, W) or (H, W, 3) uint8 image; n may be 0."""
        _, found = _detector(self.kind, self.max_features, self.contrast).detectAndCompute(gray(image), None)
        if found is None or len(found) == 0:
            return np.zeros((0, self.size), np.float32)
        found = found[: self.max_features]  # SIFT can return more if the weakest ones are equally strong
        if self.kind == "orb":
            return np.unpackbits(found, axis=1).astype(np.float32)
        tiny = np.float32(1e-12)
        if self.root:
            return np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), tiny))
        return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), tiny)


@dataclass(frozen=True)
class Vocabulary:
    """The ``centers`` (v, d) float32 of the words, the extractor, and a text that says how they were ``made``."""

    centers: np.ndarray
    extractor: Extractor
    made: str = ""

    def __len__(self) -> int:
        return len(self.centers)

    def count_descriptors(self, descriptors: np.ndarray) -> np.ndarray:
        """Count each word among descriptors (n, d): (v,) int32."""
        return np.bincount(nearest_centers(descriptors, self.centers), minlength=len(self)).astype(np.int32)


def nearest_centers(descriptors: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Return the index (n,) of the center (k, d) nearest to each descriptor (n, d) in Euclidean distance."""
    squares = np.einsum("kd,kd->k", centers, centers)
    nearest = np.empty(len(descriptors), np.intp)
    for start in range(0, len(descriptors), BLOCK_ROWS):
        block = descriptors[start : start + BLOCK_ROWS]
        nearest[start : start + len(block)] = np.argmin(squared_distances(block, centers, 0, squares), axis=1)
    return nearest


def kmeans(descriptors: np.ndarray, words: int, seed: int = 0) -> np.ndarray:
    """Return ``words`` centers (words, d) float32 of the descriptors (n, d) by k-means."""
    if len(descriptors) < words:
        raise InputError(
            f"{len(descriptors)} descriptors cannot make {words} words; take more training images or fewer words"
        )
    first = descriptors[np.random.default_rng(seed).choice(len(descriptors), words, replace=False)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of equal first centers all but one stay empty
        centers, _ = kmeans2(descriptors, first, iter=ITERATIONS, minit="matrix")
    return np.asarray(centers, np.float32)
