"""Computes from poses, and depth if available, how much of one view is visible in another: the soft truth.

The rule of :mod:`loopclosure.places.same_place` is strict. By that rule, two views of one wall are different places if
the cameras are 3 m from each other or rotated by 20 degrees, but a loop between them is not a mistake. Here, points on
a grid in one view are projected into the other. The distance of a point is the measured depth, or else each of three
assumed distances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.frames import read_depth
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.same_place import distances_m, view_angles_deg
from loopclosure.places.trajectory import Poses

ASSUMED_M = (2.0, 4.0, 8.0)
FOV_DEG = 60.0  # of a camera that is not known
GRID = (6, 8)  # rows and columns of points in a view
# A point is hidden in the other view if it is farther away than the surface seen there by more than this factor.
HIDDEN = 1.25
WIDEST_TURN_DEG = 90.0


@dataclass(frozen=True)
class ViewOverlap:
    """The rule for overlapping views; the defaults were chosen for indoor robots and hand-held cameras.

    fov_deg   horizontal field of view; None: that of the camera if known, else 60. Pixels are assumed square, and the
              principal point at the center
    least     the minimum share of each of the two views that must be visible in the other
    """

    fov_deg: float | None = None
    least: float = 0.25

    def __post_init__(self) -> None:
        if not 0 < self.fov < 180 or not 0 < self.least <= 1:
            raise InputError(f"overlap: {self.fov:g} degrees, share {self.least:g}; expected 0..180 and 0..1")

    @property
    def fov(self) -> float:
        """The horizontal field of view in degrees."""
        return FOV_DEG if self.fov_deg is None else self.fov_deg

    def of_camera(self, camera: Intrinsics | None) -> ViewOverlap:
        """Return a copy with the field of view of ``camera``, if none was given and the camera is known."""
        if self.fov_deg is not None or camera is None or camera.size is None:
            return self
        return replace(self, fov_deg=math.degrees(2 * math.atan(camera.size[0] / 2 / camera.fx)))

    def describe(self, measured: bool) -> str:
        """Return the rule as text."""
        distances = f"assumed distances of {', '.join(f'{d:g}' for d in ASSUMED_M)} m"
        return (
            f"at least {100 * self.least:g} % of each view is visible in the other, by the poses and "
            f"{f'measured depth, or {distances} where it is missing' if measured else distances} "
            f"(horizontal field of view {self.fov:.3g} degrees)"
        )


@dataclass(frozen=True)
class Views:
    """N views: poses, and three distances for each grid point along the viewing axis, (N, points, 3), in meters.

    measured  (N, points) bool: all three distances are the measured depth
    """

    poses: Poses
    ranges: NDArray[np.float64]
    measured: NDArray[np.bool_]


def views(poses: Poses, depth_images: Sequence[Path | None] = ()) -> Views:
    """Make views of N poses; ``depth_images`` has a path for each, None for those without depth, or is empty."""
    count = len(poses)
    rows, columns = GRID
    ranges = np.broadcast_to(np.array(ASSUMED_M), (count, rows * columns, 3)).copy()
    measured = np.zeros((count, rows * columns), bool)
    for i, path in enumerate(depth_images):
        if path is None:
            continue
        depth = read_depth(path)
        y = ((np.arange(rows) + 0.5) / rows * depth.shape[0]).astype(int)
        x = ((np.arange(columns) + 0.5) / columns * depth.shape[1]).astype(int)
        meters = depth[np.ix_(y, x)].reshape(-1)
        measured[i] = meters > 0
        ranges[i, measured[i]] = meters[measured[i], None]
    return Views(poses, ranges, measured)


def overlap_matrix(
    queries: Views, references: Views, settings: ViewOverlap | None = None, aspect: float = 0.75
) -> NDArray[np.bool_]:
    """Return which views overlap (Q, R); ``aspect`` is the height of an image over its width."""
    settings = settings or ViewOverlap()
    there = _shares(queries, references, settings, aspect)
    back = there.T if queries is references else _shares(references, queries, settings, aspect).T
    return np.minimum(there, back) >= settings.least


def _shares(a: Views, b: Views, settings: ViewOverlap, aspect: float) -> NDArray[np.float64]:
    """Return the share of the points of each view of ``a`` (N) that each view of ``b`` (M) sees: (N, M)."""
    half = np.tan(np.radians(settings.fov) / 2)
    rows, columns = GRID
    y, x = np.mgrid[:rows, :columns].reshape(2, -1)
    rays = np.stack([(2 * (x + 0.5) / columns - 1) * half, (2 * (y + 0.5) / rows - 1) * half * aspect], axis=1)
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    rotations_a, rotations_b = (Rotation.from_quat(each.poses.quaternions).as_matrix() for each in (a, b))
    shares = np.zeros((len(a.poses), len(b.poses)))
    reach = 2 * max(a.ranges.max(initial=0), b.ranges.max(initial=0))
    for i in range(len(a.poses)):
        here = a.poses[i : i + 1]
        near = (distances_m(here, b.poses) < reach) & (view_angles_deg(here, b.poses) < WIDEST_TURN_DEG)
        others = np.flatnonzero(near)
        points = (rays[:, None, :] * a.ranges[i][:, :, None]).reshape(-1, 3) @ rotations_a[i].T + a.poses.positions[i]
        seen = (points[None] - b.poses.positions[others, None]) @ rotations_b[others]
        depth = np.where(seen[..., 2] > 1e-6, seen[..., 2], np.inf)
        across, down = seen[..., 0] / depth / half, seen[..., 1] / depth / (half * aspect)
        visible = np.isfinite(depth) & (np.abs(across) <= 1) & (np.abs(down) <= 1)
        column = np.clip(((across + 1) / 2 * columns).astype(int), 0, columns - 1)
        row = np.clip(((down + 1) / 2 * rows).astype(int), 0, rows - 1)
        cell = row * columns + column
        limit = np.where(b.measured, b.ranges[..., 0] * HIDDEN, np.inf)[others]
        visible &= depth <= np.take_along_axis(limit, cell, axis=1)
        shares[i, others] = visible.mean(axis=1)
    return shares
