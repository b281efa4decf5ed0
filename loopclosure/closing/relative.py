"""The pose of one image relative to another that shows the same place: from depth, or from color alone.

With depth the pose is in meters: it is computed from points of one image with depth and their pixels in the other
(PnP). From color alone the essential matrix gives the rotation and the direction of the translation, not its length;
:mod:`loopclosure.closing.length` computes depth from the odometry. If the camera only rotated, all points fit a
rotation and the direction is noise; then only the rotation is returned.

Each pose is refined by least squares over the points that agree with it, and has a covariance s^2 (J^T J)^-1, with the
Jacobian J of the points' errors and the variance s^2 of the residuals.

Hartley and Zisserman, Multiple View Geometry, chapters 5, 9 and 11.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.closing.graph import cross_matrices
from loopclosure.detector.verification import LocalFeatures
from loopclosure.places.intrinsics import Intrinsics
from netspec.files.opencv import cv2

METRIC, UP_TO_SCALE, ROTATION_ONLY = "metric", "up to scale", "rotation only"
DEPTH = "depth"  # how a length was measured
LEAST_INLIERS = 20
MAX_ERROR_PX = 2.0
CONFIDENCE = 0.999
# SIFT points are accurate to about a pixel. If a rotation leaves a smaller residual, there is no usable translation.
LEAST_PARALLAX_PX = 2.0
SEED = 1
REFINEMENTS = 10  # steps of least squares
SPREAD = 3.0  # a point with this many times the median error counts a quarter


@dataclass(frozen=True)
class View:
    """An image: its ``local`` features, its ``camera``, and the depths (K,) of its points in meters, or None.

    A depth is the distance along the axis of the camera; 0 where not known. ``depths_by`` says how it was measured:
    "depth" images or the "odometry".
    """

    local: LocalFeatures
    camera: Intrinsics
    depths: np.ndarray | None = None
    depths_by: str = DEPTH


@dataclass(frozen=True)
class Relative:
    """The pose of a query in the frame of its match.

    pose        (7,) tx ty tz qx qy qz qw; "up to scale": the translation has length 1; "rotation only": it is 0
    kind        "metric", "up to scale" or "rotation only"
    inliers     matches that agree with it
    covariance  (6, 6) of the translation, then of the rotation vector, in the frame of the query as errors in g2o; from
                the residuals of the points, so without errors of the calibration and of the depth. What ``kind`` says
                is not measured, the length or the translation, has zeros
    length_by   how the length was measured: "depth" or "odometry"; "" if it is not known
    parallax    "up to scale": the median angle in radians by which a rotation alone misses the points
    """

    pose: np.ndarray
    kind: str
    inliers: int
    covariance: np.ndarray
    length_by: str = ""
    parallax: float = np.inf

    @property
    def sigmas(self) -> tuple[float, float]:
        """The standard deviations of the translation and of the rotation in radians, of one axis on the average."""
        shift, turn = (float(np.sqrt(np.trace(self.covariance[at, at]) / 3)) for at in (slice(0, 3), slice(3, 6)))
        return shift, turn


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
            return found.relative(view is match, view.depths_by)
    return _from_color(in_match, in_query, focal)


@dataclass(frozen=True)
class _Motion:
    """The motion x -> rotation x + translation of points (N, 3), and their residuals (N, 2) in the other image."""

    rotation: np.ndarray
    translation: np.ndarray
    points: np.ndarray
    residuals: np.ndarray

    def relative(self, from_match: bool, by: str) -> Relative:
        """Return the pose of the query; ``from_match``: the points are in the frame of the match, not of the query."""
        seen = self.points @ self.rotation.T + self.translation
        depth = seen[:, 2]
        projecting = np.zeros((len(seen), 2, 3))
        projecting[:, 0, 0] = projecting[:, 1, 1] = 1 / depth
        projecting[:, :, 2] = -seen[:, :2] / depth[:, None] ** 2
        # A small motion of the query moves the points in its frame.
        in_query = seen if from_match else self.points
        by_point = projecting if from_match else projecting @ self.rotation
        jacobian = np.concatenate([by_point, -by_point @ cross_matrices(in_query)], axis=2).reshape(-1, 6)
        covariance = _covariance(jacobian, self.residuals.ravel())
        pose = _pose(self.rotation, self.translation, inverse=from_match)
        return Relative(pose, METRIC, len(seen), covariance, by)


def _from_depth(rays: np.ndarray, depths: np.ndarray, seen: np.ndarray, focal: float) -> _Motion | None:
    """Return the motion that takes the points rays * depths (N,) to where they are ``seen`` (N, 2)."""
    if len(rays) < LEAST_INLIERS:
        return None
    points = _homogeneous(rays) * depths[:, None]
    cv2.setRNGSeed(SEED)
    error = MAX_ERROR_PX / focal
    solved, rotation, translation, inliers = cv2.solvePnPRansac(
        points, seen, np.eye(3), None, iterationsCount=500, reprojectionError=error, confidence=CONFIDENCE
    )
    if not solved or inliers is None or len(inliers) < LEAST_INLIERS:
        return None
    kept = inliers[:, 0].astype(np.intp)
    points, seen = points[kept], seen[kept]
    rotation, translation = cv2.solvePnPRefineLM(points, seen, np.eye(3), None, rotation, translation)
    residuals = cv2.projectPoints(points, rotation, translation, np.eye(3), None)[0].reshape(-1, 2) - seen
    return _Motion(cv2.Rodrigues(rotation)[0], translation[:, 0], points, residuals)


def _from_color(in_match: np.ndarray, in_query: np.ndarray, focal: float) -> Relative | None:
    cv2.setRNGSeed(SEED)
    essential, mask = cv2.findEssentialMat(in_match, in_query, np.eye(3), cv2.RANSAC, CONFIDENCE, MAX_ERROR_PX / focal)
    if essential is None or essential.shape != (3, 3):
        return None
    inliers = mask[:, 0] > 0
    count = int(np.count_nonzero(inliers))
    if count < LEAST_INLIERS:
        return None
    turn, turned, apart = _best_rotation(in_match[inliers], in_query[inliers])
    parallax = float(np.median(np.linalg.norm(apart, axis=1)))
    if parallax * focal < LEAST_PARALLAX_PX:
        covariance = np.zeros((6, 6))
        # A direction has two numbers, not three: a third of the residuals is 0.
        covariance[3:, 3:] = 1.5 * _covariance(cross_matrices(turned).reshape(-1, 3), apart.ravel())
        return Relative(_pose(turn.as_matrix(), np.zeros(3), inverse=True), ROTATION_ONLY, count, covariance)
    count, rotation, translation, ahead = cv2.recoverPose(essential, in_match, in_query, np.eye(3), mask=mask.copy())
    if count < LEAST_INLIERS:
        return None
    kept = ahead[:, 0] > 0
    rotation, translation, covariance = _refined(rotation, translation[:, 0], in_match[kept], in_query[kept], 1 / focal)
    pose = _pose(rotation, translation, inverse=True)
    return Relative(pose, UP_TO_SCALE, int(count), covariance, parallax=parallax)


def _refined(
    rotation: np.ndarray, translation: np.ndarray, in_match: np.ndarray, in_query: np.ndarray, pixel: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the motion from match to query with the least Sampson errors of rays (N, 2), and its covariance (6, 6).

    The translation has length 1. Some points agree within two pixels and are false, so points with large errors get
    small weights (iteratively reweighted least squares). No point counts as more accurate than a ``pixel``, its size
    at depth 1: most of the points of one wall fit each other better, but their errors are not independent.
    """
    a, b = _homogeneous(in_match), _homogeneous(in_query)
    normal, free, variance = np.eye(5), across(translation), 0.0
    for step in range(REFINEMENTS + 1):
        turned = a @ rotation.T
        lines, back = np.cross(translation, turned), np.cross(b, translation) @ rotation
        lengths = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
        errors = (b * lines).sum(axis=1) / lengths
        # The derivatives by a small motion of the query's frame.
        free = across(translation)
        jacobian = np.hstack([np.cross(turned, b), np.cross(lines, b)]) / lengths[:, None] @ free
        weights = 1 / (1 + (errors / max(SPREAD * float(np.median(np.abs(errors))), pixel)) ** 2) ** 2
        normal = jacobian.T @ (weights[:, None] * jacobian)
        variance = max(pixel**2, float(weights @ errors**2) / max(float(weights.sum()) - 5, 1.0))
        if step == REFINEMENTS:
            break
        change = free @ -np.linalg.lstsq(normal, jacobian.T @ (weights * errors), rcond=None)[0]
        turn = Rotation.from_rotvec(change[3:]).as_matrix()
        rotation, translation = turn @ rotation, turn @ translation + change[:3]
        translation = translation / np.linalg.norm(translation)
    return rotation, translation, free @ (variance * np.linalg.pinv(normal, hermitian=True)) @ free.T


def across(translation: np.ndarray) -> np.ndarray:
    """Return the five directions (6, 5) that a pose up to scale measures: two across its translation, and the turns."""
    found = np.zeros((6, 5))
    found[:3, :2] = np.linalg.svd(translation[None])[2][1:].T
    found[3:, 2:] = np.eye(3)
    return found


def _covariance(jacobian: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Return the covariance (P, P) of P parameters by residuals (M,) and their derivatives (M, P)."""
    variance = float(residuals @ residuals) / max(len(residuals) - jacobian.shape[1], 1)
    return variance * np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)


def _homogeneous(rays: np.ndarray) -> np.ndarray:
    return np.column_stack([rays, np.ones(len(rays))])


def _best_rotation(in_match: np.ndarray, in_query: np.ndarray) -> tuple[Rotation, np.ndarray, np.ndarray]:
    """Return the rotation that aligns rays (N, 2) best, the turned directions (N, 3), and their errors (N, 3).

    Outliers get small weights (iteratively reweighted least squares).
    """
    a, b = _homogeneous(in_match), _homogeneous(in_query)
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    weights, turned = np.ones(len(a)), a
    rotation = Rotation.identity()
    for _ in range(5):
        rotation = Rotation.align_vectors(b, a, weights=weights)[0]
        turned = rotation.apply(a)
        residuals = np.linalg.norm(b - turned, axis=1)
        weights = 1 / (1 + (residuals / max(2 * float(np.median(residuals)), 1e-9)) ** 2) ** 2
    return rotation, turned, b - turned


def _pose(rotation: np.ndarray, translation: np.ndarray, inverse: bool) -> np.ndarray:
    """Return the motion x -> rotation x + translation, or its inverse, as a pose (7,) with qw >= 0."""
    turn = Rotation.from_matrix(rotation)
    if inverse:
        turn = turn.inv()
        translation = -turn.apply(translation)
    return np.concatenate([translation, turn.as_quat(canonical=True)])
