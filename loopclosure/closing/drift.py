"""Odometry as a robot would have it: simulated drift on a true path; and how far two paths are apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from loopclosure.detector.export import relative_pose
from loopclosure.errors import InputError

Array = NDArray[np.float64]

# With a drift of 1 %: this much of rotation per meter, as of a turn of one degree.
DEGREES_PER_M = 0.1


def steps_between(poses: Array) -> Array:
    """Return the pose (N - 1, 7) of each of N poses (7,) in the frame of the one before."""
    return relative_pose(poses[:-1], poses[1:])


def path_of(start: Array, steps: Array) -> Array:
    """Chain steps (N - 1, 7) from a first pose (7,): the poses (N, 7)."""
    positions, turns = [start[:3]], [Rotation.from_quat(start[3:])]
    for step, turn in zip(steps[:, :3], Rotation.from_quat(steps[:, 3:]), strict=True):
        positions.append(positions[-1] + turns[-1].apply(step))
        turns.append(turns[-1] * turn)
    return np.hstack([positions, Rotation.concatenate(turns).as_quat(canonical=True)])


def drifted(truth: Array, percent: float, seed: int) -> Array:
    """Return the odometry (N, 7) that a robot with ``percent`` of drift has of a true path (N, 7).

    Each step is off by that share of its length, in a direction fixed in the camera, and turned by that share of its
    own turn plus 0.1 degrees per meter and percent about a fixed axis: calibration errors, which add up. Noise of the
    same size in each step comes on top, which hardly does. Direction, axis and noise follow from the seed.
    """
    if not 0 < percent <= 100:
        raise InputError(f"a drift of {percent:g} %; expected a number above 0, at most 100")
    rng = np.random.default_rng(seed)
    direction, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    steps = steps_between(truth)
    turns = Rotation.from_quat(steps[:, 3:])
    lengths = np.linalg.norm(steps[:, :3], axis=1)[:, None]
    off = percent / 100 * lengths
    turned = percent / 100 * turns.magnitude()[:, None] + np.radians(DEGREES_PER_M) * percent * lengths
    steps[:, :3] += off * (direction + rng.normal(size=(len(steps), 3)))
    noise = Rotation.from_rotvec(turned * (axis + rng.normal(size=(len(steps), 3))))
    steps[:, 3:] = (turns * noise).as_quat(canonical=True)
    return path_of(truth[0], steps)


def aligned(path: Array, truth: Array, known: NDArray[np.bool_]) -> Array:
    """Return poses (N, 7) moved and turned as a whole, so that the ``known`` (N,) are nearest to those of ``truth``.

    Umeyama, PAMI 1991, without scale.
    """
    middle, true_middle = path[known, :3].mean(axis=0), truth[known, :3].mean(axis=0)
    u, _, v = np.linalg.svd((truth[known, :3] - true_middle).T @ (path[known, :3] - middle))
    turn = Rotation.from_matrix(u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v)
    positions = turn.apply(path[:, :3] - middle) + true_middle
    return np.hstack([positions, (turn * Rotation.from_quat(path[:, 3:])).as_quat(canonical=True)])


def ate_rmse_m(path: Array, truth: Array) -> float:
    """Return the absolute trajectory error of positions after alignment, root mean square in meters.

    Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.
    """
    apart = aligned(path, truth, np.ones(len(path), bool))[:, :3] - truth[:, :3]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def turn_rmse_deg(path: Array, truth: Array) -> float:
    """Return the root mean square of the angles between the rotations of two paths, after the best common turn."""
    a, b = (Rotation.from_quat(poses[:, 3:]) for poses in (path, truth))
    common = (b * a.inv()).mean()
    return float(np.degrees(np.sqrt(np.mean(((common * a).inv() * b).magnitude() ** 2))))
