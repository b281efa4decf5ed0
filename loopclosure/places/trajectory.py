"""Camera poses in time, and the files of the TUM RGB-D benchmark that hold them.

A sequence is a folder with ``rgb.txt`` (``timestamp filename``) and ``groundtruth.txt`` (``timestamp tx ty tz qx qy qz
qw``). A pose is camera-to-world: the position of the optical center in meters and a unit quaternion with w last; the
camera looks along its +z, x to the right, y down. Stamps are in seconds.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from loopclosure.errors import InputError
from netspec.files.kinds import unreadable
from netspec.files.whole_file import write_whole

# TUM's associate.py allows 0.02 s; with 30 Hz images and 100 Hz motion capture, 0.03 s does no harm.
MAX_DIFFERENCE_S = 0.03
# With four decimals the norm is within 1e-3 of 1. If it differs much more, the numbers are not a quaternion.
NORM_TOLERANCE = 0.05


@dataclass(frozen=True)
class Poses:
    """Poses without a time: ``positions`` (..., 3) in meters, ``quaternions`` (..., 4) xyzw of unit length."""

    positions: NDArray[np.float64]
    quaternions: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: int | slice | NDArray) -> Poses:
        return Poses(self.positions[index], self.quaternions[index])


@dataclass(frozen=True)
class Trajectory:
    """Poses in time: ``stamps`` (N,) in s, ascending; ``positions`` (N, 3) in meters; ``quaternions`` (N, 4) xyzw."""

    stamps: NDArray[np.float64]
    positions: NDArray[np.float64]
    quaternions: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def poses(self) -> Poses:
        """The N poses without their time."""
        return Poses(self.positions, self.quaternions)


Posed = Poses | Trajectory


def write_rgb_list(
    path: str | os.PathLike[str], frames: Iterable[tuple[float, str]], what: str = "color images"
) -> None:
    """Write ``rgb.txt`` or ``depth.txt`` with TUM's three comment lines.

    frames  the stamp in seconds, written with microseconds, and the file of each, relative to the list
    """
    lines = [f"# {what}", f"# file: '{Path(path).parent.name}'", "# timestamp filename"]
    lines += [f"{stamp:.6f} {file}" for stamp, file in frames]
    write_whole(Path(path), "\n".join(lines) + "\n", "backslashreplace")


def write_trajectory(path: str | os.PathLike[str], trajectory: Trajectory, what: str = "ground truth") -> None:
    """Write poses in TUM's form with its three comment lines; meters and quaternions with six decimals."""
    lines = [f"# {what} trajectory", f"# file: '{Path(path).parent.name}'", "# timestamp tx ty tz qx qy qz qw"]
    for stamp, position, quaternion in zip(
        trajectory.stamps, trajectory.positions, trajectory.quaternions, strict=True
    ):
        lines.append(f"{stamp:.6f} " + " ".join(f"{value:.6f}" for value in (*position, *quaternion)))
    write_whole(Path(path), "\n".join(lines) + "\n", "backslashreplace")


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


def content_lines(
    path: str | os.PathLike[str], expected: str, comments: list[str] | None = None
) -> Iterator[tuple[int, str]]:
    """Yield the lines that are not empty and not a comment, with their numbers from 1.

    Comments are added to ``comments``.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(unreadable(path, error, expected), path) from error
    except UnicodeDecodeError as error:
        raise InputError(f"is not a text file; expected {expected}", path) from error
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line
        elif line.strip() and comments is not None:
            comments.append(line)


def number(text: str, name: str, path: str | os.PathLike[str], line: int, column: int) -> float:
    """Return a field of a file as a number; ``name`` is for the message.

    Raises InputError (file:line:column) if it is not a number, or if it is too large to compute distances with.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(16 * value * value):
        raise InputError(f'expected a number for {name}, found "{text}"', path, line, column)
    return value
