"""What odometry tells of loops: frames that it puts far apart, more than it can have drifted, show different places."""

from __future__ import annotations

import numpy as np

from loopclosure.places.same_place import MAX_DISTANCE_M

DRIFT = 0.1  # of the way: more than odometry is usually off
FAR_M = 2 * MAX_DISTANCE_M  # from there on two frames show different places


def far_apart(poses: np.ndarray) -> np.ndarray:
    """Return which frames (N, N) bool odometry puts far apart.

    poses  (N, 7) of odometry in meters, in the order of time; NaN where it is not known
    """
    positions = poses[:, :3]
    known = np.all(np.isfinite(positions), axis=1)
    way = np.zeros(len(poses))
    way[known] = np.cumsum(np.linalg.norm(np.diff(positions[known], axis=0, prepend=positions[known][:1]), axis=1))
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    return apart > FAR_M + DRIFT * np.abs(np.subtract.outer(way, way))  # False for NaN
