"""Depth by a known distance between two images: the odometry moved the camera from one to the other.

Two color images give the translation between them up to its length. A neighbor of one of them, in the same drive, shows
some of the same points, and the odometry knows the distance of the neighbors. So the two neighbors give the depth of
these points in meters, and with depth the pose of a loop is in meters. Only the length of the odometry is used, over
one step; the direction and the rotation of the step come from the images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.closing.relative import METRIC, UP_TO_SCALE, Relative, View, relative_view
from loopclosure.detector.export import STEP_M, STEP_SHARE
from loopclosure.detector.verification import LocalFeatures

ODOMETRY = "odometry"
STEPS_M = 0.3, 0.1  # distances to a neighbor by the odometry, in the order in which they are tried
FARTHEST = 20  # frames to a neighbor
LEAST_PARALLAX_PX = 3.0  # of a point whose depth is used
OFF_PX = 2.0  # of a point from where the other camera sees it
Matching = Callable[[LocalFeatures, LocalFeatures], np.ndarray]
Neighbors = Iterable[tuple[View, float]]  # of an image: another image, and its distance by the odometry in meters


def neighbors(odometry: np.ndarray, frame: int, drives: np.ndarray) -> list[tuple[int, float]]:
    """Return the neighbors of a frame, and their distances in meters, by odometry (N, 7), NaN where not known.

    ``drives`` (N,) has the piece of the path of each frame; a neighbor is of the same piece.
    """
    found = []
    for least in STEPS_M:
        for way in (-1, 1):
            for number in range(frame + way, frame + way * (FARTHEST + 1), way):
                if not 0 <= number < len(odometry) or drives[number] != drives[frame]:
                    break
                length = float(np.linalg.norm(odometry[number, :3] - odometry[frame, :3]))
                if length >= least:
                    found.append((number, length))
                    break
    return list(dict(found).items())


def measured(views: tuple[View, View], around: tuple[Neighbors, Neighbors], matching: Matching) -> Relative | None:
    """Return the pose of a loop's query in the frame of its match, in meters if it can be; None if there is none.

    views     of the match and of the query
    around    the neighbors of each
    matching  two images -> the matches (M, 2) of their points
    """
    matches = matching(views[0].local, views[1].local)
    relative = relative_view(*views, matches)
    return None if relative is None else with_length(relative, views, matches, around, matching)


def with_length(
    relative: Relative,
    views: tuple[View, View],
    matches: np.ndarray,
    around: tuple[Neighbors, Neighbors],
    matching: Matching,
) -> Relative:
    """Return the pose of a loop in meters if a neighbor of its match or its query gives depth, else itself.

    ``matches`` (M, 2) are those of the points of the two views; for the others see :func:`measured`.
    """
    if relative.kind == METRIC:
        return relative
    bare = [View(view.local, view.camera) for view in views]
    for end, near in enumerate(around):
        for neighbor, step_m in near:
            other = View(neighbor.local, neighbor.camera)
            shared = matching(bare[end].local, other.local)
            step = relative_view(bare[end], other, shared)
            if step is None or step.kind != UP_TO_SCALE:
                continue
            ends = bare.copy()
            ends[end] = replace(
                bare[end], depths=step_m * _depths(bare[end], other, step.pose, shared), depths_by=ODOMETRY
            )
            found = relative_view(ends[0], ends[1], matches)
            if found is not None and found.kind == METRIC:
                # An error of the step's length changes all depths, and with them the translation, by the same share.
                share = STEP_SHARE + STEP_M / step_m
                along = share * Rotation.from_quat(found.pose[3:]).inv().apply(found.pose[:3])
                covariance = found.covariance.copy()
                covariance[:3, :3] += np.outer(along, along)
                return replace(found, covariance=covariance)
    return relative


def _depths(view: View, other: View, pose: np.ndarray, matches: np.ndarray) -> np.ndarray:
    """Return the depths (K,) of the points of a view by another at ``pose``, 0 where not known.

    A point needs enough parallax, must be ahead of both cameras, and lie where the other camera sees it.
    """
    depths = np.zeros(len(view.local.points))
    here = view.camera.rays(view.local.points[matches[:, 0]])
    there = other.camera.rays(other.local.points[matches[:, 1]])
    a, b = (np.column_stack([rays, np.ones(len(rays))]) for rays in (here, there))
    back = Rotation.from_quat(pose[3:]).inv()
    turned, step = back.apply(a), back.apply(pose[:3])
    # The point z a is on the ray b of the other camera: b x (z turned - step) = 0.
    across = np.cross(b, turned)
    wide = np.linalg.norm(across, axis=1)
    with np.errstate(all="ignore"):  # points at infinity, and pixels that have no ray
        z = (across * np.cross(b, step)).sum(axis=1) / wide**2
        seen = z[:, None] * turned - step
        off = np.linalg.norm(seen[:, :2] / seen[:, 2:] - there, axis=1)
        focal = float(np.sqrt(view.camera.fx * view.camera.fy))
        known = (z > 0) & (seen[:, 2] > 0) & (off * focal < OFF_PX) & (wide * focal > LEAST_PARALLAX_PX)
    depths[matches[known, 0]] = z[known]
    return depths
