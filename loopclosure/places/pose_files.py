"""Reads files of poses in the formats of TUM, KITTI and EuRoC, and checks whether a path looks wrong.

TUM    ``timestamp tx ty tz qx qy qz qw``: seconds, meters, w last
KITTI  twelve numbers, the upper three rows of a 4 x 4 matrix; no time: one row per image
EuRoC  ``timestamp,px,py,pz,qw,qx,qy,qz,...``: nanoseconds, meters, w first; further columns are ignored

The first line or a comment before it may name the columns; the quaternion is then read in their order.

All of them give the pose of the camera (EuRoC: the body) in the world, unless the form has ``world-to-camera``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.pose_table import UNITS, form_of, numbers_of, read_lines, seconds_of
from loopclosure.places.trajectory import MAX_DIFFERENCE_S, associate

FORMS = ("tum", "kitti", "euroc")
ORDERS = ("w-first", "w-last")
DIRECTIONS = ("camera-to-world", "world-to-camera")
# A step is a jump if its speed is this many times the 99th percentile, and it is longer than this.
JUMP_FACTOR, JUMP_M = 10.0, 0.5
# A car or a robot always moves in one direction of its own frame. If that is so only with another reading of the poses,
# that reading is likely to be right. A hand-held camera moves in all directions, so it gives no hint.
ONE_WAY, ALL_WAYS, SHORTER = 0.9, 0.7, 0.5


@dataclass(frozen=True)
class PoseForm:
    """How to read a file of poses; an empty field means the default.

    form       "tum", "kitti" or "euroc"; default: found from the rows
    order      "w-first" or "w-last" of the quaternion; default: as the header says, or w first for EuRoC, last for TUM
    direction  "camera-to-world" (default) or "world-to-camera"
    """

    form: str = ""
    order: str = ""
    direction: str = ""


@dataclass(frozen=True)
class PoseFile:
    """N poses, camera-to-world: ``poses`` (N, 7) tx ty tz qx qy qz qw, and ``stamps`` (N,) in s, None for KITTI.

    A row that has no usable pose is NaN. ``doubts`` are sentences about what looks wrong.
    """

    poses: np.ndarray
    stamps: np.ndarray | None
    form: PoseForm
    doubts: tuple[str, ...] = field(default=())

    def of_images(
        self,
        images: int,
        stamps: np.ndarray | None,
        path: str | os.PathLike[str],
        max_difference: float = MAX_DIFFERENCE_S,
    ) -> np.ndarray:
        """Return the poses (images, 7) of images with these stamps, NaN where none is within ``max_difference`` [s].

        If the poses or the images have no stamps, pose i belongs to image i. Raises InputError if their numbers differ
        then, or if no image has a pose.
        """
        if self.stamps is None or stamps is None:
            if len(self.poses) != images:
                missing = "the poses have no time" if self.stamps is None else "the images have no time"
                raise InputError(
                    f"has {len(self.poses)} poses, but there are {images} images; {missing}, so pose i must be "
                    "that of image i",
                    path,
                )
            return self.poses
        known = np.isfinite(self.poses).all(axis=1)
        poses = self.poses[known]
        nearest = associate(stamps, self.stamps[known], max_difference)
        for unit in UNITS:  # times since the start of a drive do not tell their unit
            found = associate(stamps, self.stamps[known] * unit, max_difference)
            if nearest.max() < 0 and np.mean(found >= 0) > 0.5:
                nearest = found
        if nearest.max() < 0:
            raise InputError(
                f"none of {images} images has a pose within {max_difference:g} s: images from {stamps[0]:.3f} to "
                f"{stamps[-1]:.3f} s, poses from {self.stamps[0]:.3f} to {self.stamps[-1]:.3f} s",
                path,
            )
        return np.where(nearest[:, None] < 0, np.nan, poses[nearest])


def pose_form(text: str) -> PoseForm:
    """Parse words such as ``tum,w-first,world-to-camera``. Raises InputError for unknown words."""
    chosen = {}
    for word in filter(None, text.split(",")):
        for name, known in (("form", FORMS), ("order", ORDERS), ("direction", DIRECTIONS)):
            if word in known:
                chosen[name] = word
                break
        else:
            known_words = ", ".join((*FORMS, *ORDERS, *DIRECTIONS))
            raise InputError(f'"{word}" is not a form of poses; known: {known_words}')
    return PoseForm(**chosen)


def read_poses(path: str | os.PathLike[str], form: PoseForm = PoseForm()) -> PoseFile:
    """Read a file of poses, sorted by time if it has stamps.

    Rows without a usable pose are NaN; ``doubts`` counts them. Raises InputError (file:line:column) if no row is
    usable, or if the form cannot be told from the rows.
    """
    lines = read_lines(path)
    kind = form.form or form_of(lines, form.order, path)
    order = form.order or lines.order or ("w-first" if kind == "euroc" else "w-last")
    table, faults = numbers_of(lines, kind, order, path)
    if kind == "kitti":
        stamps, matrices, usable = None, table.reshape(-1, 3, 4), np.isfinite(table).all(axis=1)
        poses = np.full((len(table), 7), np.nan)
        turns = Rotation.from_matrix(matrices[usable, :, :3]).as_quat(canonical=True)
        poses[usable] = np.hstack([matrices[usable, :, 3], turns])
    else:
        table = table[np.isfinite(table[:, 0])]
        table = table[np.argsort(table[:, 0], kind="stable")]
        stamps, quaternions = _seconds(table[:, 0], kind), table[:, 4:]
        if order == "w-first":
            quaternions = np.roll(quaternions, -1, axis=1)
        poses = np.hstack([table[:, 1:4], quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)])
    if form.direction == "world-to-camera":
        poses = inverse(poses)
    read = PoseForm(kind, "" if kind == "kitti" else order, form.direction or DIRECTIONS[0])
    known = np.isfinite(poses).all(axis=1)
    found = doubts(poses[known], None if stamps is None else stamps[known], read)
    return PoseFile(poses, stamps, read, (*([str(faults)] if faults else []), *found))


def _seconds(times: np.ndarray, kind: str) -> np.ndarray:
    """Return times in seconds. EuRoC's are nanoseconds, also if they are counted from the start of the drive."""
    seconds = seconds_of(times)
    relative = kind == "euroc" and seconds is times and np.all(times % 1 == 0) and times[-1] > 1e6
    return times * 1e-9 if relative else seconds


def inverse(poses: np.ndarray) -> np.ndarray:
    """Return the inverse (N, 7) of each pose (7,); NaN stays NaN."""
    known, back = np.isfinite(poses).all(axis=1), np.full(poses.shape, np.nan)
    turns = Rotation.from_quat(poses[known, 3:]).inv()
    back[known] = np.hstack([-turns.apply(poses[known, :3]), turns.as_quat(canonical=True)])
    return back


def moved(poses: np.ndarray, mount: np.ndarray) -> np.ndarray:
    """Return the poses (N, 7) of a sensor from the poses of its body; ``mount`` (4, 4): its pose in the body.

    NaN stays NaN.
    """
    known, there = np.isfinite(poses).all(axis=1), np.full(poses.shape, np.nan)
    turns = Rotation.from_quat(poses[known, 3:])
    positions = poses[known, :3] + turns.apply(mount[:3, 3])
    there[known] = np.hstack([positions, (turns * Rotation.from_matrix(mount[:3, :3])).as_quat(canonical=True)])
    return there


def doubts(poses: np.ndarray, stamps: np.ndarray | None, form: PoseForm = PoseForm()) -> list[str]:
    """Return sentences about poses (N, 7) that look wrong: jumps, inverted poses, order of the quaternion."""
    found = []
    steps = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    if len(steps) < 10:
        return found
    times = np.ones(len(steps)) if stamps is None else np.maximum(np.diff(stamps), 1e-6)
    speeds = steps / times
    usual = float(np.percentile(speeds, 99 if len(steps) > 200 else 90))
    jumps = np.flatnonzero((speeds > JUMP_FACTOR * usual) & (steps > JUMP_M))
    if len(jumps):
        at = int(jumps[np.argmax(steps[jumps])])
        often = f"{len(jumps)} {'time' if len(jumps) == 1 else 'times'}"
        found.append(
            f"the path jumps {often}: by {steps[at]:.3g} m from pose {at + 1} to {at + 2}, "
            f"where steps are mostly below {float(np.percentile(steps, 90)):.2g} m"
        )
    direction = DIRECTIONS[form.direction != DIRECTIONS[1]]
    back = inverse(poses)
    shorter = np.linalg.norm(np.diff(back[:, :3], axis=0), axis=1).sum() < SHORTER * steps.sum()
    if shorter and _one_way(back) > ONE_WAY:
        found.append(
            f"read as {direction}, the path is less than half as long, and the camera always moves one way: if that is "
            f"right, say so with pose-form={direction}"
        )
    if form.form != "kitti" and _one_way(poses) < ALL_WAYS:
        order = ORDERS[form.order != ORDERS[1]]
        if _one_way(np.hstack([poses[:, :3], _other_order(poses[:, 3:], form.order)])) > ONE_WAY:
            found.append(
                "the camera would move now forward, now sideways or back as it turns; with the quaternion read "
                f"{order} it always moves one way: if that is right, say so with pose-form={order}"
            )
    return found


def _other_order(quaternions: np.ndarray, order: str) -> np.ndarray:
    """Convert quaternions xyzw that were read in ``order`` to the other order."""
    return np.roll(quaternions, 1, axis=1) if order == "w-first" else np.roll(quaternions, -1, axis=1)


def _one_way(poses: np.ndarray) -> float:
    """Return how constant the direction of motion is in the camera's frame: 0 all directions, 1 always the same."""
    every = max(1, len(poses) // 200)  # longer steps: the direction of a short one is noise
    poses = poses[::every]
    steps = np.diff(poses[:, :3], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    long = lengths > 0.2 * np.median(lengths)
    if not lengths[long].any():
        return 0.0
    own = Rotation.from_quat(poses[:-1, 3:][long]).inv().apply(steps[long] / lengths[long, None])
    return float(np.linalg.norm(own.mean(axis=0)))
