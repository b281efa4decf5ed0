"""Camera poses in time, and writing them in the form of the TUM RGB-D benchmark.

A pose (7,), tx ty tz qx qy qz qw, is camera-to-world: the optical center in meters and a unit quaternion; the camera
looks along its +z, x to the right, y down. Stamps are in seconds.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from netspec.files.whole_file import write_whole

# TUM's associate.py allows 0.02 s; with 30 Hz images and 100 Hz motion capture, 0.03 s does no harm.
MAX_DIFFERENCE_S = 0.03
GAP_S = 0.5  # no pose is taken between two that are further apart
# A step is a jump if it is longer than this, and so many times as fast as nine of ten others. Moves below LEAST_M are
# noise of a robot that stands.
JUMP_M, JUMP_FACTOR, LEAST_M = 0.5, 10.0, 0.01


def inverse(poses: np.ndarray) -> np.ndarray:
    """Return the inverse (N, 7) of each pose (7,), tx ty tz qx qy qz qw; NaN stays NaN."""
    known, back = np.isfinite(poses).all(axis=1), np.full(poses.shape, np.nan)
    turns = Rotation.from_quat(poses[known, 3:]).inv()
    back[known] = np.hstack([-turns.apply(poses[known, :3]), turns.as_quat(canonical=True)])
    return back


def moved(poses: np.ndarray, mount: np.ndarray) -> np.ndarray:
    """Return the poses (N, 7) of a sensor from those of its body; ``mount`` (4, 4): its pose in the body."""
    known, there = np.isfinite(poses).all(axis=1), np.full(poses.shape, np.nan)
    turns = Rotation.from_quat(poses[known, 3:])
    positions = poses[known, :3] + turns.apply(mount[:3, 3])
    there[known] = np.hstack([positions, (turns * Rotation.from_matrix(mount[:3, :3])).as_quat(canonical=True)])
    return there


def jumps(poses: np.ndarray, stamps: np.ndarray | None = None) -> np.ndarray:
    """Return which steps (N - 1,) between poses (N, 7) are jumps: of an odometry that was reset, or to another drive.

    Without ``stamps`` (N,), all steps take the same time. A stamp that goes back begins another drive.
    """
    lengths = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    timed = stamps is not None and bool(np.isfinite(stamps).all())
    times = np.diff(stamps) if timed and stamps is not None else np.ones(len(lengths))
    speeds = lengths / np.maximum(times, 1e-3)
    moving = speeds[lengths > LEAST_M]
    usual = np.percentile(moving, 90 if len(moving) >= 10 else 50, method="lower") if len(moving) else 0.0
    return (times < 0) | ((lengths > JUMP_M) & (speeds > JUMP_FACTOR * usual))


def pieces(poses: np.ndarray, stamps: np.ndarray | None = None, starts: Sequence[int] | np.ndarray = ()) -> np.ndarray:
    """Return the number (N,) of the piece of a path (N, 7) that each frame belongs to; a jump separates two pieces.

    Poses may be NaN. ``starts`` are the first frames of drives, if there are several.
    """
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    begins = np.zeros(len(poses), int)
    begins[known[1:]] = jumps(poses[known], None if stamps is None else stamps[known])
    begins[[start for start in starts if 0 < start < len(poses)]] = 1
    return np.cumsum(begins)


def at(stamps: np.ndarray, poses: np.ndarray, times: np.ndarray, gap_s: float = GAP_S) -> np.ndarray:
    """Return the poses (M, 7) at ``times`` (M,) of a path with ascending ``stamps`` (N,) and poses (N, 7).

    Between two poses, the motion has a constant speed. A time is NaN if it is before the first pose or after the last
    one, or between two that are more than ``gap_s`` seconds or a jump apart.
    """
    after = np.searchsorted(stamps, times).clip(0, len(stamps) - 1)
    before = np.where(stamps[after] == times, after, (after - 1).clip(0))
    gap = np.append(0, np.cumsum(jumps(poses, stamps)))
    inside = (stamps[before] <= times) & (times <= stamps[after]) & (stamps[after] - stamps[before] <= gap_s)
    inside &= gap[before] == gap[after]
    first, second = poses[before], poses[after]
    share = ((times - stamps[before]) / np.where(after > before, stamps[after] - stamps[before], 1))[:, None]
    begin = Rotation.from_quat(first[:, 3:])
    turn = Rotation.from_rotvec(share * (begin.inv() * Rotation.from_quat(second[:, 3:])).as_rotvec())
    found = np.hstack([(1 - share) * first[:, :3] + share * second[:, :3], (begin * turn).as_quat(canonical=True)])
    return np.where(inside[:, None], found, np.nan)


def associate(
    frame_stamps: NDArray[np.float64], stamps: NDArray[np.float64], max_difference: float = MAX_DIFFERENCE_S
) -> NDArray[np.intp]:
    """Find for each frame (N,) the nearest of ascending ``stamps``: its index (N,), -1 if none is near enough.

    ``max_difference`` is in seconds. Frames may share a pose, unlike in TUM's associate.py, which pairs one to one:
    poses come faster than images.
    """
    after = np.searchsorted(stamps, frame_stamps).clip(0, len(stamps) - 1)
    before = (after - 1).clip(0)
    nearest = np.where(np.abs(stamps[before] - frame_stamps) <= np.abs(stamps[after] - frame_stamps), before, after)
    return np.where(np.abs(stamps[nearest] - frame_stamps) <= max_difference, nearest, -1)


def write_rgb_list(
    path: str | os.PathLike[str], frames: Iterable[tuple[float, str]], what: str = "color images"
) -> None:
    """Write ``rgb.txt`` or ``depth.txt`` with TUM's three comment lines.

    frames  the stamp in seconds, written with microseconds, and the file of each, relative to the list
    """
    rows = (f"{stamp:.6f} {file}" for stamp, file in frames)
    _write(path, what, "timestamp filename", rows)


def write_trajectory(
    path: str | os.PathLike[str], stamps: np.ndarray, poses: np.ndarray, what: str = "ground truth"
) -> None:
    """Write poses (N, 7) with their stamps (N,) in TUM's form with its three comment lines, with six decimals."""
    table = np.column_stack([stamps, poses])
    rows = (" ".join(f"{value:.6f}" for value in row) for row in table)
    _write(path, f"{what} trajectory", "timestamp tx ty tz qx qy qz qw", rows)


def _write(path: str | os.PathLike[str], what: str, columns: str, rows: Iterable[str]) -> None:
    lines = [f"# {what}", f"# file: '{Path(path).parent.name}'", f"# {columns}", *rows]
    write_whole(Path(path), "\n".join(lines) + "\n", "backslashreplace")
