"""Writes loops to files: a CSV table, and a pose graph (g2o) for an optimizer.

A g2o file has one line per vertex and per edge. A vertex is ``VERTEX_SE3:QUAT id x y z qx qy qz qw``. An edge is
``EDGE_SE3:QUAT i j``, followed by the pose of j in the frame of i, T_i^-1 T_j, and the 21 entries of the upper triangle
of the information matrix, row by row: translation first, then rotation.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.csv_file import write_csv
from loopclosure.detector.decision import LoopResult
from loopclosure.errors import InputError
from netspec.files.whole_file import write_whole

VERTEX, EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
RELATIVE = (
    "relative",
    *("qx", "qy", "qz", "qw", "dx", "dy", "dz", "length_m", "agreeing", "sigma_m", "sigma_deg"),
    "length_by",
    "covariance",
)
LOOPS = (
    "query_id",
    "match_id",
    "score",
    "inliers",
    "query_stamp",
    "match_stamp",
    "query_name",
    "match_name",
    "score_of",
)

STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])  # the pose of a frame in itself

# A pose (7,) of the query in the frame of the match and its information (6, 6), or None.
RelativePose = Callable[[int, int], tuple[np.ndarray, np.ndarray] | None]


@dataclass(frozen=True)
class Sigmas:
    """The uncertainty of an edge: standard deviations of its translation in meters and of its rotation in radians."""

    translation_m: float
    rotation_rad: float

    def information(self) -> np.ndarray:
        """Return the information matrix (6, 6), which is diagonal."""
        return np.diag([self.translation_m**-2] * 3 + [self.rotation_rad**-2] * 3)


# The uncertainty of a step of the odometry: a share of its length or angle, and a constant in meters or radians.
STEP_SHARE, STEP_M = 0.02, 0.002
TURN_SHARE, TURN_RAD = 0.02, 0.002
LOOP_SIGMAS = Sigmas(0.1, 0.05)


def relative_pose(pose_a: np.ndarray, pose_b: np.ndarray) -> np.ndarray:
    """Return the pose (..., 7) of each b in the frame of a, T_a^-1 T_b, with w >= 0; a pose is tx ty tz qx qy qz qw."""
    back, there = Rotation.from_quat(pose_a[..., 3:]).inv(), Rotation.from_quat(pose_b[..., 3:])
    step = back.apply(pose_b[..., :3] - pose_a[..., :3])
    return np.concatenate([step, (back * there).as_quat(canonical=True)], axis=-1)


def after(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the pose (..., 7) that has the pose ``step`` (..., 7) in the frame of ``pose``."""
    turn = Rotation.from_quat(pose[..., 3:])
    place = pose[..., :3] + turn.apply(step[..., :3])
    return np.concatenate([place, (turn * Rotation.from_quat(step[..., 3:])).as_quat(canonical=True)], axis=-1)


def write_loops_csv(
    path: str | Path,
    loops: Sequence[LoopResult],
    stamps: np.ndarray | None = None,
    names: Sequence[str] | None = None,
    matched: tuple[np.ndarray | None, Sequence[str]] | None = None,
    measured: tuple[Sequence[str], Mapping[int, Sequence[object]]] | None = None,
) -> None:
    """Write one row per loop: query_id, match_id, score, inliers, and stamps (N,) in seconds and names (N) if known.

    The last column says whether the score is one of images or of sequences.

    matched    the stamps and names (M) of the matches, if they are frames of another drive
    measured   the names of further columns, such as RELATIVE, and query_id -> their cells; no row: nothing is known
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    others = (stamps, names) if matched is None else matched
    every, all_names = (stamps, others[0]), (names, others[1])
    columns, cells = measured or ((), {})
    unknown = [""] * len(columns)
    rows = []
    for loop in loops:
        assert loop.match is not None
        ends = (loop.query, loop.match)
        times = ["" if of is None or np.isnan(of[i]) else f"{of[i]:.6f}" for of, i in zip(every, ends, strict=True)]
        names_of_ends = ["" if of is None else of[i] for of, i in zip(all_names, ends, strict=True)]
        inliers = "" if loop.inliers is None else loop.inliers
        more = cells.get(loop.query, unknown)
        rows.append([*ends, f"{loop.score:.9g}", inliers, *times, *names_of_ends, loop.score_of, *more])
    write_csv(path, (*LOOPS, *columns), rows, "surrogateescape")


def information_of_step(step: np.ndarray) -> np.ndarray:
    """Return the information (6, 6) of a step (7,) of the odometry."""
    length, turn = float(np.linalg.norm(step[:3])), float(Rotation.from_quat(step[3:]).magnitude())
    return Sigmas(STEP_SHARE * length + STEP_M, TURN_SHARE * turn + TURN_RAD).information()


def write_g2o(
    path: str | Path,
    poses: np.ndarray,
    loops: Sequence[LoopResult],
    relative: RelativePose,
    drives: np.ndarray | None = None,
) -> int:
    """Write a pose graph; return how many loops were left out because their relative pose is not known.

    poses     (N, 7) poses of the frames, tx ty tz qx qy qz qw, as the robot estimates them; NaN if not known. They are
              the vertices, and consecutive poses of one drive give the odometry edges.
    relative  (query_id, match_id) -> pose (7,) of the query in the frame of the match and its information (6, 6), or
              None. It must be measured
              (by the images, depth, or motion capture), and never come from the robot's poses, because the loop is
              to correct their drift. Loops without it are left out.
    drives    (N,) the piece of the path that each frame belongs to; None: all are of one
    """
    poses = np.asarray(poses, np.float64)
    known: list[int] = np.flatnonzero(np.all(np.isfinite(poses), axis=1)).tolist()
    if not known:
        raise InputError("no frame has a pose; a pose graph needs the poses of the frames")
    steps = [(a, b) for a, b in itertools.pairwise(known) if drives is None or drives[a] == drives[b]]
    moves = [relative_pose(poses[a], poses[b]) for a, b in steps]
    edges = [(a, b, move, information_of_step(move)) for (a, b), move in zip(steps, moves, strict=True)]
    left_out = 0
    with_pose = set(known)
    for loop in loops:
        assert loop.match is not None
        edge = relative(loop.query, loop.match)
        if edge is None or not {loop.query, loop.match} <= with_pose:
            left_out += 1
            continue
        edges.append((loop.match, loop.query, *edge))
    write_pose_graph(path, {i: poses[i] for i in known}, edges)
    return left_out


def write_pose_graph(
    path: str | Path, vertices: Mapping[int, np.ndarray], edges: Iterable[tuple[int, int, np.ndarray, np.ndarray]]
) -> None:
    """Write vertices, number -> pose (7,), and edges: i, j, pose (7,) of j in the frame of i, information (6, 6)."""
    upper = np.triu_indices(6)
    lines = [f"{VERTEX} {i} {_numbers(pose)}" for i, pose in vertices.items()]
    for i, j, pose, information in edges:
        lines.append(f"{EDGE} {i} {j} {_numbers(pose)} {_numbers(information[upper])}")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, "\n".join(lines) + "\n")


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)
