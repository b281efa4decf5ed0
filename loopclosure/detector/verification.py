"""Whether two images show the same scene, by geometry: SIFT, the ratio test, RANSAC on the fundamental matrix.

Where the camera is known, the essential matrix, which has fewer degrees of freedom, replaces the fundamental matrix.

A flat scene, or a camera that only rotates, does not determine the fundamental matrix. Its inliers still count points
that agree, so such pairs are accepted. A pair needs texture: two views of a bare wall fail.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from loopclosure.errors import InputError

# Fewer matches prove nothing: any seven have a fundamental matrix.
LEAST_MATCHES = 8


@dataclass(frozen=True)
class LocalFeatures:
    """Points of an image (K, 2) float32, x and y in pixels, and their SIFT descriptors (K, 128) uint8."""

    points: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True)
class GeometricCheck:
    """Decides by the number of point matches that agree with one fundamental or essential matrix.

    max_features   how many of the strongest SIFT points are kept per image; 500 need 66 kB of memory per frame
    ratio          a match must be nearer than ``ratio`` times the second nearest (Lowe's test)
    max_error_px   distance of an inlier from its epipolar line, in pixels
    confidence     of RANSAC
    min_inliers    the least number of inliers of a loop
    focal_px       focal length in pixels of the images as they are; 0: not known, a fundamental matrix is used
    center_x_px    principal point, with focal_px
    center_y_px
    """

    max_features: int = 500
    ratio: float = 0.8
    max_error_px: float = 2.0
    confidence: float = 0.985
    min_inliers: int = 20
    focal_px: float = 0.0
    center_x_px: float = 0.0
    center_y_px: float = 0.0

    def describe(self, image: np.ndarray) -> LocalFeatures:
        """Find the points of an image (H, W) or (H, W, 3) uint8; there may be none."""
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        points, descriptors = cv2.SIFT.create(self.max_features).detectAndCompute(gray, None)
        if descriptors is None or not len(points):
            return LocalFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
        # OpenCV's SIFT descriptors are integers up to 255, in float32: bytes hold them without loss.
        places = np.array([point.pt for point in points], np.float32)
        return LocalFeatures(places[: self.max_features], descriptors[: self.max_features].astype(np.uint8))

    def matches(self, a: LocalFeatures, b: LocalFeatures) -> np.ndarray:
        """Return the matches (M, 2), points of ``a`` and ``b``, that pass the ratio test; no point of ``b`` twice."""
        if len(a.points) < 2 or len(b.points) < 2:
            return np.zeros((0, 2), np.int64)
        # As float32: with bytes the matcher takes several times as long.
        matcher = cv2.BFMatcher(cv2.NORM_L2)
        nearest_two = matcher.knnMatch(a.descriptors.astype(np.float32), b.descriptors.astype(np.float32), k=2)
        passed = [best for best, second in nearest_two if best.distance < self.ratio * second.distance]
        point_of_a: dict[int, int] = {}
        for match in sorted(passed, key=lambda match: match.distance):
            point_of_a.setdefault(match.trainIdx, match.queryIdx)
        return np.array(sorted((i, j) for j, i in point_of_a.items()), np.int64).reshape(-1, 2)

    def inliers(self, a: LocalFeatures, b: LocalFeatures) -> int:
        """Count the matches that agree with one fundamental or essential matrix; 0 if there are too few."""
        matches = self.matches(a, b)
        if len(matches) < LEAST_MATCHES:
            return 0
        points = a.points[matches[:, 0]], b.points[matches[:, 1]]
        if self.focal_px:
            camera = np.array([[self.focal_px, 0, self.center_x_px], [0, self.focal_px, self.center_y_px], [0, 0, 1]])
            matrix, mask = cv2.findEssentialMat(*points, camera, cv2.RANSAC, self.confidence, self.max_error_px)
        else:
            matrix, mask = cv2.findFundamentalMat(*points, cv2.FM_RANSAC, self.max_error_px, self.confidence)
        # Without a matrix OpenCV 5.0.0 does not fill in the mask. Of several solutions the mask says nothing.
        return 0 if matrix is None or matrix.shape != (3, 3) else int(np.count_nonzero(mask))

    def accepts(self, inliers: int) -> bool:
        """Return whether this many inliers are enough."""
        return inliers >= self.min_inliers

    def __post_init__(self) -> None:
        if self.max_features < LEAST_MATCHES or self.min_inliers < LEAST_MATCHES or not 0 < self.ratio <= 1:
            raise InputError(
                f"geometric check: {self.max_features} features, {self.min_inliers} inliers, ratio {self.ratio:g}; "
                f"expected at least {LEAST_MATCHES} of both and a ratio in 0..1"
            )
        camera = (self.focal_px, self.center_x_px, self.center_y_px)
        if min(camera) < 0 or (any(camera) and not all(camera)):
            raise InputError(
                "geometric check: a known camera needs focal_px, center_x_px and center_y_px, all above 0; "
                f"got {', '.join(f'{value:g}' for value in camera)}"
            )
