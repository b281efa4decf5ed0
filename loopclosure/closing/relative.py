"""The pose of one image relative to another that shows the same place: from depth, or from color alone.

With depth the pose is in meters: it is computed from points of one image with depth and their pixels in the other
(PnP). From color alone the essential matrix gives the rotation and the direction of the translation, not its length.
If the camera only rotated, all points fit a rotation and the direction is noise; then only the rotation is returned.

Hartley and Zisserman, Multiple View Geometry, chapters 9 and 11.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.detector.verification import LocalFeatures
from loopclosure.places.intrinsics import Intrinsics
from netspec.files.opencv import cv2

METRIC, UP_TO_SCALE, ROTATION_ONLY = "metric", "up to scale", "rotation only"
LEAST_INLIERS = 20
MAX_ERROR_PX = 2.0
CONFIDENCE = 0.999
# SIFT points are accurate to about a pixel. If a rotation leaves a smaller residual, there is no usable translation.
LEAST_PARALLAX_PX = 2.0
SEED = 1


@dataclass(frozen=True)
class View:
    """An image: its ``local`` features, its ``camera``, and the depths (K,) of its points in meters, or None.

    A depth is the distance along the axis of the camera; 0 where not known.
    """

    local: LocalFeatures
    camera: Intrinsics
    depths: np.ndarray | None = None


@dataclass(frozen=True)
class Relative:
    """The pose of a query in the frame of its match.

    pose     (7,) tx ty tz qx qy qz qw; "up to scale": the translation has length 1; "rotation only": it is 0
    kind     "metric", "up to scale" or "rotation only"
    inliers  matches that agree with it
    sigmas   standard deviations of its translation in meters and of its rotation in radians, from the residuals of the
             points; None if it is not metric. They do not contain errors of the calibration or of the depth
    """

    pose: np.ndarray
    kind: str
    inliers: int
    sigmas: tuple[float, float] | None = None


def relative_view(match: View, query: View, matches: np.ndarray) -> Relative | None:
    """Return the pose of ``query`` in the frame of ``match`` from matches (M, 2) of their points, or None.

    It is None if fewer than LEAST_INLIERS matches agree with one pose. Equal arguments give equal results, because the
    random generator of RANSAC has a fixed seed.
    """
    if len(matches) < LEAST_INLIERS:
        return None
    pixels = match.local.points[matches[:, 0]], query.local.points[matches[:, 1]]
    in_match, in_query = match.camera.rays(pixels[0]), query.camera.rays(pixels[1])
    ahead = np.isfinite(in_match).all(axis=1) & np.isfinite(in_query).all(axis=1)
    if np.count_nonzero(ahead) < LEAST_INLIERS:
        return None
    matches, in_match, in_query = matches[ahead], in_match[ahead], in_query[ahead]
    focal = np.sqrt(query.camera.fx * query.camera.fy)
    directions = ((match, matches[:, 0], in_match, in_query), (query, matches[:, 1], in_query, in_match))
    for view, points, rays, other in directions:
        if view.depths is None:
            continue
        depths = view.depths[points]
        known = depths > 0
        found = _from_depth(rays[known], depths[known], other[known], focal)
        if found is not None:
            rotation, translation, inliers, sigmas = found  # from this view to the other
            return Relative(_pose(rotation, translation, inverse=view is match), METRIC, inliers, sigmas)
    return _from_color(in_match, in_query, focal)


def _from_depth(
    rays: np.ndarray, depths: np.ndarray, seen: np.ndarray, focal: float
) -> tuple[np.ndarray, np.ndarray, int, tuple[float, float]] | None:
    """Return the motion that takes the points rays * depths (N,) to where they are ``seen`` (N, 2).

    It is a rotation (3, 3), a translation (3,), the number of points that agree, and the sigmas of :class:`Relative`.
    """
    if len(rays) < LEAST_INLIERS:
        return None
    points = np.column_stack([rays, np.ones(len(rays))]) * depths[:, None]
    cv2.setRNGSeed(SEED)
    error = MAX_ERROR_PX / focal
    solved, rotation, translation, inliers = cv2.solvePnPRansac(
        points, seen, np.eye(3), None, iterationsCount=500, reprojectionError=error, confidence=CONFIDENCE
    )
    if not solved or inliers is None or len(inliers) < LEAST_INLIERS:
        return None
    kept = inliers[:, 0].astype(np.intp)
    rotation, translation = cv2.solvePnPRefineLM(points[kept], seen[kept], np.eye(3), None, rotation, translation)
    return (
        cv2.Rodrigues(rotation)[0],
        translation[:, 0],
        len(kept),
        _sigmas(points[kept], seen[kept], rotation, translation),
    )


def _sigmas(points: np.ndarray, seen: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> tuple[float, float]:
    """Return the standard deviations of a translation in meters and a rotation in radians, of one axis on the average.

    The covariance is s^2 (J^T J)^-1, with the Jacobian J of the projections and the variance s^2 of their residuals.
    """
    projected, jacobian = cv2.projectPoints(points, rotation, translation, np.eye(3), None)
    residuals = (projected.reshape(-1, 2) - seen).ravel()
    variance = float(residuals @ residuals) / max(len(residuals) - 6, 1)
    covariance = variance * np.linalg.pinv(jacobian[:, :6].T @ jacobian[:, :6])  # rotation first
    turn, shift = (float(np.sqrt(np.trace(covariance[part, part]) / 3)) for part in (slice(0, 3), slice(3, 6)))
    return shift, turn


def _from_color(in_match: np.ndarray, in_query: np.ndarray, focal: float) -> Relative | None:
    cv2.setRNGSeed(SEED)
    essential, mask = cv2.findEssentialMat(in_match, in_query, np.eye(3), cv2.RANSAC, CONFIDENCE, MAX_ERROR_PX / focal)
    if essential is None or essential.shape != (3, 3):
        return None
    inliers = mask[:, 0] > 0
    if np.count_nonzero(inliers) < LEAST_INLIERS:
        return None
    only_rotation, parallax = _best_rotation(in_match[inliers], in_query[inliers])
    if parallax * focal < LEAST_PARALLAX_PX:
        return Relative(_pose(only_rotation, np.zeros(3), inverse=True), ROTATION_ONLY, int(np.count_nonzero(inliers)))
    count, rotation, translation, _ = cv2.recoverPose(essential, in_match, in_query, np.eye(3), mask=mask.copy())
    if count < LEAST_INLIERS:
        return None
    return Relative(_pose(rotation, translation[:, 0], inverse=True), UP_TO_SCALE, int(count))


def _best_rotation(in_match: np.ndarray, in_query: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the rotation (3, 3) that aligns the rays (N, 2) best, and the median of the remaining distances.

    Distances are at depth 1. Outliers get small weights (iteratively reweighted least squares).
    """
    a, b = (np.column_stack([rays, np.ones(len(rays))]) for rays in (in_match, in_query))
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    weights, residuals = np.ones(len(a)), np.zeros(len(a))
    rotation = Rotation.identity()
    for _ in range(5):
        rotation = Rotation.align_vectors(b, a, weights=weights)[0]
        residuals = np.linalg.norm(b - rotation.apply(a), axis=1)
        weights = 1 / (1 + (residuals / max(2 * float(np.median(residuals)), 1e-9)) ** 2) ** 2
    return rotation.as_matrix(), float(np.median(residuals))


def _pose(rotation: np.ndarray, translation: np.ndarray, inverse: bool) -> np.ndarray:
    """Return the motion x -> rotation x + translation, or its inverse, as a pose (7,) with qw >= 0."""
    turn = Rotation.from_matrix(rotation)
    if inverse:
        turn = turn.inv()
        translation = -turn.apply(translation)
    return np.concatenate([translation, turn.as_quat(canonical=True)])
