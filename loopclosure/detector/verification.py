"""Geometric verification of image pairs: SIFT, the ratio test, RANSAC on the fundamental matrix.

If the camera is known, the essential matrix is used instead; it has fewer degrees of freedom.

The number of inliers that a pair needs depends on the number of matches, the size of the images and the largest
distance of an inlier from its epipolar line. It is large enough that chance does not explain the inliers; see Moisan
and Stival, "A probabilistic criterion to detect rigid point matches between two images and estimate the fundamental
matrix" (IJCV 2004). Small images are enlarged first, because SIFT finds no points smaller than about two pixels.

A flat scene, or a camera that only rotates, does not determine the fundamental matrix. The inliers still count points
that agree, so such pairs are accepted. A pair needs texture: two views of a bare wall are rejected. The texture must be
in several parts of the image, because a sign or a printed code can appear in many places.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from loopclosure.decision.constants import SURE
from loopclosure.descriptors.similarity import squared_distances
from loopclosure.errors import InputError
from netspec.files.opencv import cv2

# Fewer matches prove nothing: any seven have a fundamental matrix.
LEAST_MATCHES = 8
# The largest expected number of matrices per image pair that as many matches fit by chance. It is small because points
# of one object are not independent, and because a detector compares thousands of pairs.
BY_CHANCE = 1e-6
# Of a pair that is accepted against its score, so many of the matches must be inliers. Two floors of a tower have the
# same doors and signs, but also points that match at other positions: a poster, another number.
SHARE = 0.7
SAMPLE, SOLUTIONS = 7, 3  # matches in a sample, and the largest number of fundamental matrices they give
PARTS = (8, 6)  # of an image, across and down
SPREAD = 5  # at most 1 / SPREAD of the needed inliers are counted in one part
# The largest factor by which an image is enlarged; a larger one adds no detail.
MOST_ENLARGED = 4.0


@dataclass(frozen=True)
class LocalFeatures:
    """Points of an image (K, 2) float32, x and y in pixels, and their SIFT descriptors (K, 128) uint8.

    size  width and height of the image
    """

    points: np.ndarray
    descriptors: np.ndarray
    size: tuple[int, int] = (640, 480)


class Agreement(NamedTuple):
    """The matches of two images, the inliers of one matrix among them, and the inliers needed to rule out chance.

    If the inliers crowd in few parts of an image, only some are counted, fewer than needed.
    """

    matches: int
    inliers: int
    needed: int

    @property
    def whole(self) -> bool:
        """Whether most matches are inliers, as of one place; of two that look alike, only a part of it is the same."""
        return self.inliers >= SHARE * self.matches


@dataclass(frozen=True)
class GeometricCheck:
    """Decides by the number of point matches that agree with one fundamental or essential matrix.

    max_features   how many of the strongest SIFT points are kept per image; 500 need 66 kB of memory per frame
    ratio          a match must be nearer than ``ratio`` times the second nearest (Lowe's test)
    max_error_px   largest distance of an inlier from its epipolar line, in pixels of the enlarged or reduced image
    confidence     of RANSAC
    least_side     an image with a shorter side below this is enlarged to it, at most four times
    most_side      an image with a shorter side above this is reduced to it; SIFT takes 39 ms of 640x480 reduced to 320
                   (74 without), and of images of 240 reduced by as much, as many right pairs are verified at the desk
                   and 9 % fewer in the kitchen
    focal_px       focal length in pixels of the original images; 0: not known, a fundamental matrix is used
    center_x_px, center_y_px  principal point, with focal_px
    """

    max_features: int = 500
    ratio: float = 0.8
    max_error_px: float = 2.0
    confidence: float = 0.985
    least_side: int = 240
    most_side: int = 320
    focal_px: float = 0.0
    center_x_px: float = 0.0
    center_y_px: float = 0.0

    def scaled(self, size: tuple[int, int]) -> float:
        """Return the factor by which images of ``size`` (width, height) are enlarged or reduced."""
        side = max(1, min(size))
        return min(MOST_ENLARGED, max(1.0, self.least_side / side), self.most_side / side)

    def describe(self, image: np.ndarray) -> LocalFeatures:
        """Find the points of an image (H, W) or (H, W, 3) uint8; there may be none."""
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        size = (gray.shape[1], gray.shape[0])
        factor = self.scaled(size)
        if factor != 1:
            how = cv2.INTER_CUBIC if factor > 1 else cv2.INTER_AREA
            gray = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=how)
        points, descriptors = cv2.SIFT.create(self.max_features).detectAndCompute(gray, None)
        if descriptors is None or not len(points):
            return LocalFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8), size)
        # OpenCV's SIFT descriptors are integers up to 255, in float32: bytes hold them without loss.
        places = np.array([point.pt for point in points], np.float32)
        if factor != 1:  # in both images the center of the first pixel is at 0
            places = (places + 0.5) / np.float32(factor) - 0.5
        kept = slice(self.max_features)
        return LocalFeatures(places[kept], descriptors[kept].astype(np.uint8), size)

    def matches(self, a: LocalFeatures, b: LocalFeatures) -> np.ndarray:
        """Return the matches (M, 2), points of ``a`` and ``b``, that pass the ratio test; no point of ``b`` twice."""
        if len(a.points) < 2 or len(b.points) < 2:
            return np.zeros((0, 2), np.int64)
        # Products and sums of bytes are below 2^24, so float32 holds them exactly. This is several times as fast as
        # OpenCV's matcher.
        rows, columns = a.descriptors.astype(np.float32), b.descriptors.astype(np.float32)
        lengths, others = np.square(rows).sum(axis=1), np.square(columns).sum(axis=1)
        squares = squared_distances(rows, columns, lengths[:, None], others)
        numbers, nearest = np.arange(len(rows)), squares.argmin(axis=1)
        best = np.sqrt(squares[numbers, nearest]).astype(np.float64)
        squares[numbers, nearest] = np.inf
        second = np.sqrt(squares.min(axis=1)).astype(np.float64)
        passed = np.flatnonzero(best < self.ratio * second)
        passed = passed[np.argsort(best[passed], kind="stable")]
        passed = np.sort(passed[np.unique(nearest[passed], return_index=True)[1]])  # the nearest one to each point of b
        return np.column_stack([passed, nearest[passed]])

    def inliers(self, a: LocalFeatures, b: LocalFeatures) -> int:
        """Count the matches that agree with one fundamental or essential matrix; 0 if chance explains them."""
        return self.enough(self.agreement(a, b))

    def agreement(self, a: LocalFeatures, b: LocalFeatures) -> Agreement:
        """Match the points of two images, and count the matches that agree with one matrix."""
        matches = self.matches(a, b)
        factor = self.scaled(b.size)
        size = (round(b.size[0] * factor), round(b.size[1] * factor))
        needed = _needed(len(matches), *size, self.max_error_px)
        if len(matches) < LEAST_MATCHES:
            return Agreement(len(matches), 0, needed)
        points = a.points[matches[:, 0]], b.points[matches[:, 1]]
        error = self.max_error_px / max(self.scaled(a.size), factor)
        if self.focal_px:
            camera = np.array([[self.focal_px, 0, self.center_x_px], [0, self.focal_px, self.center_y_px], [0, 0, 1]])
            matrix, mask = cv2.findEssentialMat(*points, camera, cv2.RANSAC, self.confidence, error)
        else:
            matrix, mask = cv2.findFundamentalMat(*points, cv2.FM_RANSAC, error, self.confidence)
        # Without a matrix OpenCV 5.0.0 does not fill in the mask; with several solutions the mask belongs to none.
        if matrix is None or matrix.shape != (3, 3):
            return Agreement(len(matches), 0, needed)
        agree = mask.reshape(-1) > 0
        count = int(np.count_nonzero(agree))
        spread = min(_spread(p[agree], image.size, needed) for p, image in zip(points, (a, b), strict=True))
        return Agreement(len(matches), count if spread >= needed else min(count, spread), needed)

    def enough(self, found: Agreement) -> int:
        """Return the inliers of an agreement; 0 if chance explains them."""
        return found.inliers if found.inliers >= found.needed else 0

    def evidence(self, found: Agreement, unlike: float = 0.0) -> float:
        """Return the inliers of an agreement divided by the number that rules out chance; 1 is enough.

        unlike  how many inliers pairs of different places have: so many more are needed
        """
        return found.inliers / (found.needed + unlike)

    def sure(self, found: Agreement) -> int:
        """Return the inliers of an agreement if they outweigh a low score; 0 otherwise."""
        return found.inliers if self.evidence(found) >= SURE and found.whole else 0

    def __post_init__(self) -> None:
        if self.max_features < LEAST_MATCHES or not 0 < self.ratio <= 1 or self.most_side < max(1, self.least_side):
            raise InputError(
                f"geometric check: {self.max_features} features, ratio {self.ratio:g}, sides {self.least_side} to "
                f"{self.most_side}; expected at least {LEAST_MATCHES} features, a ratio in 0..1, and sides in order"
            )
        camera = (self.focal_px, self.center_x_px, self.center_y_px)
        if min(camera) < 0 or (any(camera) and not all(camera)):
            raise InputError(
                "geometric check: a known camera needs focal_px, center_x_px and center_y_px, all above 0; "
                f"got {', '.join(f'{value:g}' for value in camera)}"
            )


def _part(points: np.ndarray, size: tuple[int, int], parts: tuple[int, int]) -> np.ndarray:
    """Return the part (N,) that each point (N, 2) is in; an image has ``parts`` across and down."""
    column, row = (np.floor(points * parts / size).astype(int).clip(0, np.subtract(parts, 1))).T
    return row * parts[0] + column


def _spread(points: np.ndarray, size: tuple[int, int], needed: int) -> int:
    """Count points (N, 2) of an image, at most ``needed`` / SPREAD in each part."""
    return int(np.minimum(np.bincount(_part(points, size, PARTS)), math.ceil(needed / SPREAD)).sum())


@lru_cache(4096)
def _needed(matches: int, width: int, height: int, error_px: float) -> int:
    """Return the least k with (n - 7) C(n, k) C(k, 7) 3 p^(k - 7) <= BY_CHANCE, n + 1 if there is none.

    p is the largest share of the image that can lie within ``error_px`` of a line.
    """
    share = min(1.0, 2 * error_px * math.hypot(width, height) / (width * height))
    for count in range(SAMPLE + 1, matches + 1):
        ways = math.comb(matches, count) * math.comb(count, SAMPLE) * SOLUTIONS * (matches - SAMPLE)
        if math.log(ways) + (count - SAMPLE) * math.log(share) <= math.log(BY_CHANCE):
            return count
    return matches + 1


@dataclass
class Pairs:
    """Verifies pairs of images. Results are cached: each image is described once, and each pair is matched once.

    image   reads an image: its key -> (H, W) or (H, W, 3) uint8, or its points
    """

    image: Callable[[Any], np.ndarray | LocalFeatures]
    _local: dict[tuple[GeometricCheck, Any], LocalFeatures] = field(default_factory=dict)
    _found: dict[tuple[GeometricCheck, Any, Any], Agreement] = field(default_factory=dict)

    def features(self, check: GeometricCheck, key: Any) -> LocalFeatures:
        """Return the points of an image."""
        of = (_by_points(check), key)
        if of not in self._local:
            seen = self.image(key)
            self._local[of] = seen if isinstance(seen, LocalFeatures) else check.describe(seen)
        return self._local[of]

    def agreement(self, check: GeometricCheck, a: Any, b: Any) -> Agreement:
        """Return how many points of two images agree."""
        of = (check, a, b)
        if of not in self._found:
            self._found[of] = check.agreement(self.features(check, a), self.features(check, b))
        return self._found[of]


def _by_points(check: GeometricCheck) -> GeometricCheck:
    """Return a check with only the settings that the points depend on, as a key for the cache."""
    return GeometricCheck(max_features=check.max_features, least_side=check.least_side, most_side=check.most_side)
