"""Reads tables of poses: with names of the columns, or in the forms of TUM, KITTI and EuRoC.

TUM    ``timestamp tx ty tz qx qy qz qw``: seconds, meters, w last
KITTI  twelve numbers, the upper three rows of a 4 x 4 matrix; no time: one row per image
EuRoC  seventeen numbers, ``timestamp,px,py,pz,qw,qx,qy,qz,...``: nanoseconds, meters, w first

If the first line, or a comment before it, names the columns, they are found by their names. Otherwise their number
tells the form. All of them give the pose of the camera (EuRoC: the body) in the world, unless the form has
``world-to-camera``.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.trajectory import MAX_DIFFERENCE_S, associate, at, inverse
from netspec.files.table import TIME, UNITS, Row, Table, is_number, read_table

EXPECTED = (
    "names of the columns (timestamp tx ty tz qx qy qz qw), or 8 columns (TUM), 12 (KITTI: a matrix) or 17 (EuRoC)"
)
WORDS = {
    "form": ("tum", "kitti", "euroc"),
    "order": ("w-first", "w-last"),
    "direction": ("camera-to-world", "world-to-camera"),
    "unit": tuple(UNITS),
}
_LENGTHS = {8: "tum", 12: "kitti", 17: "euroc"}
_POSITION = r"(?:.*[._])?(?:position|translation|pos|p|t)[._]?(?:\w*_)?{0}|{0}"
_QUATERNION = r"(?:.*[._])?(?:orientation|quaternion|rotation|quat|rot|q)[._]?(?:\w*_)?{0}"
NORM_TOLERANCE = 0.05  # of the length of a quaternion; with four decimals it is within 1e-3 of 1
MATRIX_TOLERANCE = 0.02  # a rotation matrix in text has at least four decimals
YEAR_1990, YEAR_2100 = 6.3e8, 4.1e9  # in seconds since 1970


@dataclass(frozen=True)
class PoseForm:
    """How to read a file of poses; an empty field means the default. ``WORDS`` has the words of each field."""

    form: str = ""
    order: str = ""
    direction: str = ""
    unit: str = ""


@dataclass(frozen=True)
class PoseFile:
    """N poses, camera-to-world: ``poses`` (N, 7) tx ty tz qx qy qz qw, and ``stamps`` (N,) in s, None for KITTI.

    A row that has no usable pose is NaN. ``doubts`` says how many there are; ``form`` is the one that was found.
    """

    poses: np.ndarray
    stamps: np.ndarray | None
    form: str
    doubts: tuple[str, ...] = ()

    def of_images(
        self,
        images: int,
        stamps: np.ndarray | None,
        path: str | os.PathLike[str],
        max_difference: float = MAX_DIFFERENCE_S,
        measured: bool = False,
    ) -> np.ndarray:
        """Return the poses (images, 7) of images with these stamps, NaN where none is within ``max_difference`` [s].

        ``measured``: the path of the robot by its odometry, in which a pose lies between two others. If the poses or
        the images have no stamps, pose i belongs to image i. Raises InputError if their numbers differ then, or if no
        image has a pose.
        """
        if self.stamps is None or stamps is None:
            if len(self.poses) != images:
                missing = "the poses have no time" if self.stamps is None else "the images have no time"
                fault = f"has {len(self.poses)} poses, but there are {images} images; {missing}"
                raise InputError(f"{fault}, so pose i must be that of image i", path)
            return self.poses
        known = np.isfinite(self.poses).all(axis=1)
        if measured:
            found = at(self.stamps[known], self.poses[known], stamps)
        else:
            nearest = associate(stamps, self.stamps[known], max_difference)
            found = np.where(nearest[:, None] < 0, np.nan, self.poses[known][nearest])
        if np.isnan(found).all():
            raise InputError(
                f"none of {images} images has a pose: images from {stamps[0]:.3f} to "
                f"{stamps[-1]:.3f} s, poses from {self.stamps[0]:.3f} to {self.stamps[-1]:.3f} s; if their unit is "
                "another one, name it: timestamp [ns] in the first line, or pose-form=ns",
                path,
            )
        return found


def pose_form(text: str) -> PoseForm:
    """Parse words such as ``tum,w-first,world-to-camera``. Raises InputError for unknown words."""
    chosen = {}
    for word in filter(None, text.split(",")):
        field = next((field for field, words in WORDS.items() if word in words), "")
        if not field:
            known = ", ".join(word for words in WORDS.values() for word in words)
            raise InputError(f'"{word}" is not a form of poses; known: {known}')
        chosen[field] = word
    return PoseForm(**chosen)


def read_poses(path: str | os.PathLike[str], form: PoseForm = PoseForm()) -> PoseFile:
    """Read a file of poses, sorted by time if it has stamps.

    Raises InputError (file:line) if no row is usable, or if the columns are not those of poses.
    """
    table = read_table(Path(path), EXPECTED)
    columns, found = _columns(table, form)
    values, faults = np.full((len(table.rows), len(columns)), np.nan), []
    for row, into in zip(table.rows, values, strict=True):
        try:
            into[:] = _numbers(row, columns, table)
        except InputError as fault:
            faults.append(fault)
            if found != "kitti" and len(row.cells) > columns[0] and is_number(row.cells[columns[0]]):
                into[0] = float(row.cells[columns[0]])  # a frame without a pose
    if len(faults) == len(table.rows):
        raise faults[0] if faults else InputError("holds no pose", path)
    first = faults[0].where.line if faults and faults[0].where else 0
    count = f"rows without a usable pose: {len(faults)} of {len(values)}"
    doubts = (f"{count}; line {first}: {faults[0].message}",) if first else ()
    if found == "kitti":
        stamps, known, poses = None, np.isfinite(values[:, 0]), np.full((len(values), 7), np.nan)
        matrices = values[known].reshape(-1, 3, 4)
        turns = Rotation.from_matrix(matrices[:, :, :3]).as_quat(canonical=True)
        poses[known] = np.hstack([matrices[:, :, 3], turns])
    else:
        unit = form.unit or table.unit(columns[0]) or ("ns" if found == "euroc" else "")
        values = values[np.isfinite(values[:, 0])]
        values = values[np.argsort(values[:, 0], kind="stable")]
        stamps, poses = values[:, 0] * UNITS[unit] if unit else seconds_of(values[:, 0]), values[:, 1:]
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return PoseFile(inverse(poses) if form.direction == "world-to-camera" else poses, stamps, found, doubts)


def seconds_of(stamps: np.ndarray) -> np.ndarray:
    """Return stamps (N,) in seconds. A date may be in s, ms, us or ns since 1970; its size tells which."""
    usual = float(np.median(stamps)) if len(stamps) else 0.0
    return next((stamps * unit for unit in UNITS.values() if YEAR_1990 < usual * unit < YEAR_2100), stamps)


def matrix_fault(matrix: np.ndarray) -> str:
    """Return why the first three columns (3, 3) of a pose are not a rotation; empty if they are."""
    difference = float(np.abs(matrix.T @ matrix - np.eye(3)).max()) if np.abs(matrix).max() < 2 else np.inf
    if not difference <= MATRIX_TOLERANCE:
        return f"its first three columns are not a rotation: M^T M differs from the identity by {difference:.3g}"
    reflected = np.linalg.det(matrix) < 0
    return "its first three columns are a reflection (determinant -1), not a rotation" if reflected else ""


def _columns(table: Table, form: PoseForm) -> tuple[list[int], str]:
    """Return the columns of time, tx ty tz and qx qy qz qw, or those of a matrix; and the form."""
    patterns = [TIME, *(_POSITION.format(axis) for axis in "xyz"), *(_QUATERNION.format(axis) for axis in "xyzw")]
    named = [table.column(pattern) for pattern in patterns]
    if table.column(r"(?:.*[._])?n(?:ano)?secs?") is not None and form.form != "kitti":
        raise InputError("has its time in two columns, seconds and nanoseconds; join them", table.path, 1, 1)
    counts = Counter(len(row.cells) for row in table.rows).most_common(1) or [(0, 0)]
    if None not in named and form.form != "kitti" and not form.order:
        of_euroc = counts[0][0] == 17 or table.column("p_rs_r_x") is not None
        return [column for column in named if column is not None], form.form or ("euroc" if of_euroc else "tum")
    if table.named and not form.form:
        found = ", ".join(table.names)
        raise InputError(f"has the columns {found}; expected {EXPECTED}", table.path, 1, 1)
    found = form.form or _LENGTHS.get(counts[0][0], "")
    if not found and table.rows:
        raise InputError(f"has {counts[0][0]} columns; expected {EXPECTED}", table.path, table.rows[0].line, 1)
    if found == "kitti":
        return list(range(12)), found
    w_first = form.order == "w-first" or (found == "euroc" and not form.order)
    return [0, 1, 2, 3, *((5, 6, 7, 4) if w_first else (4, 5, 6, 7))], found


def _numbers(row: Row, columns: list[int], table: Table) -> list[float]:
    """Return the numbers of a row. Raises InputError if they are not a pose."""
    where = table.path, row.line, 1
    if max(columns) >= len(row.cells):
        raise InputError(f"has {len(row.cells)} columns, a pose has {max(columns) + 1}", *where)
    values = [number(row.cells[column], *where) for column in columns]
    if len(values) == 12:
        if fault := matrix_fault(np.array(values).reshape(3, 4)[:, :3]):
            raise InputError(fault, *where)
    elif not abs((length := float(np.linalg.norm(values[4:]))) - 1) <= NORM_TOLERANCE:
        raise InputError(f"its quaternion has length {length:.4g}, a rotation has length 1", *where)
    return values


def number(text: str, path: str | os.PathLike[str], line: int, column: int) -> float:
    """Return a cell as a number. Raises InputError if it is none, or if it is too large to compute distances with."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(16 * value * value):
        raise InputError(f'expected a number, found "{text}"', path, line, column)
    return value
