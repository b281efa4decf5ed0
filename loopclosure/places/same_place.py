"""The rule for whether two poses are the same place. It labels training pairs and judges loop closures.

The rule of the paper (section IV): the distance between the cameras is less than 2 m, and the rotation between them is
less than 15 degrees. Both poses must be in one frame of reference; the caller must know which sequences share one.

Every function takes single poses or arrays (..., 7), tx ty tz qx qy qz qw, with NumPy's broadcasting. The arithmetic is
the same for one pair as for a matrix, so a label never depends on how it was computed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_DISTANCE_M = 2.0
MAX_ANGLE_DEG = 15.0
# Views of one place that are turned further than the rule allows; results are given by this angle too.
WIDE_ANGLE_DEG = 45.0


def distances_m(pose_a: np.ndarray, pose_b: np.ndarray) -> NDArray[np.float64]:
    """Distances (...) between the optical centers, in meters."""
    step = pose_a[..., :3] - pose_b[..., :3]
    return np.sqrt(step[..., 0] ** 2 + step[..., 1] ** 2 + step[..., 2] ** 2)


def angles_deg(pose_a: np.ndarray, pose_b: np.ndarray) -> NDArray[np.float64]:
    """Angles (...) of the rotations from one camera to the other, in degrees, 0 to 180."""
    a, b = pose_a[..., 3:], pose_b[..., 3:]
    # q and -q are the same rotation: hence the absolute value. Rounding may leave it just above 1.
    cosine = np.abs(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2] + a[..., 3] * b[..., 3])
    return np.degrees(2 * np.arccos(np.minimum(cosine, 1.0)))


def view_angles_deg(pose_a: np.ndarray, pose_b: np.ndarray) -> NDArray[np.float64]:
    """Angles (...) between the viewing axes, in degrees: unlike :func:`angles_deg`, they ignore roll about the axis."""
    a, b = _viewing_axes(pose_a[..., 3:]), _viewing_axes(pose_b[..., 3:])
    cosine = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def same_place(
    pose_a: np.ndarray, pose_b: np.ndarray, max_distance_m: float = MAX_DISTANCE_M, max_angle_deg: float = MAX_ANGLE_DEG
) -> NDArray[np.bool_]:
    """Return for each pair (...) of poses whether it is the same place: distance and angle below the two limits."""
    return (distances_m(pose_a, pose_b) < max_distance_m) & (angles_deg(pose_a, pose_b) < max_angle_deg)


def same_place_matrix(
    pose_a: np.ndarray,
    pose_b: np.ndarray,
    max_distance_m: float = MAX_DISTANCE_M,
    max_angle_deg: float = MAX_ANGLE_DEG,
    pairs_at_once: int = 1_000_000,
) -> NDArray[np.bool_]:
    """Compare each of N poses with each of M: (N, M), one byte per pair; the working memory stays small."""
    truth = np.empty((len(pose_a), len(pose_b)), bool)
    height = max(1, pairs_at_once // max(1, len(pose_b)))
    for start in range(0, len(pose_a), height):
        block = pose_a[start : start + height, None]
        truth[start : start + height] = same_place(block, pose_b, max_distance_m, max_angle_deg)
    return truth


def _viewing_axes(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cameras' +z axes (..., 3) in the world: the third column of each rotation matrix."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    return np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=-1)
