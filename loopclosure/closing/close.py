"""Corrects a path by its loops and writes the result; simulates drift; measures the error of a path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from loopclosure.closing.graph import Edge, solve
from loopclosure.closing.length import ODOMETRY
from loopclosure.closing.measure import Loop
from loopclosure.closing.relative import DEPTH, ROTATION_ONLY, UP_TO_SCALE, Relative, across
from loopclosure.csv_file import write_csv
from loopclosure.detector.export import LOOP_SIGMAS, Sigmas, information_of_step, relative_pose, write_pose_graph
from loopclosure.errors import InputError
from loopclosure.places.same_place import MAX_DISTANCE_M
from loopclosure.places.trajectory import pieces, write_trajectory

# Of the errors of a loop that all its points have in common, by the calibration, by the depth, or by a translation that
# was taken for a rotation: with depth; from color alone they are LOOP_SIGMAS.
DEPTH_SIGMAS = Sigmas(0.03, 0.01)
# Of the rays of a loop's points: an error that grows over the image by the rotation of LOOP_SIGMAS, as that of a
# rolling shutter, has a uniform distribution. A direction from color is wrong by its ratio to the parallax.
RAY_RAD = LOOP_SIGMAS.rotation_rad / 12**0.5
FAR_M = 0.5  # the length that the translation of a loop is taken to have where it is not known


@dataclass(frozen=True)
class Closed:
    """A path before and after its loops were closed.

    frames     (N,) numbers of the frames that have odometry: node i of the graph is frame frames[i]
    odometry   (N, 7) poses before
    poses      (N, 7) poses after
    steps      edges of the odometry
    edges      edges of the L loops
    loops      the L loops between nodes
    accepted   (L,) bool: the loop agrees with the rest of the graph
    not_measured  number of loops left out because no relative pose could be computed from their images
    truth      (N, 7), NaN where not known, or None
    no_path    number of loops left out because one of their frames has no odometry
    gaps       number of steps that are no edges, because the odometry jumps or another drive begins
    """

    frames: np.ndarray
    odometry: np.ndarray
    poses: np.ndarray
    steps: list[Edge]
    edges: list[Edge]
    loops: list[Loop]
    accepted: np.ndarray
    not_measured: int
    truth: np.ndarray | None = None
    no_path: int = 0
    gaps: int = 0

    def errors(self) -> dict[str, tuple[float, float]] | None:
        """Return the errors before and after, by name and unit; None without at least three true poses."""
        if self.truth is None:
            return None
        known = np.all(np.isfinite(self.truth), axis=1)
        if np.count_nonzero(known) < 3:
            return None
        before, after, truth = self.odometry[known], self.poses[known], self.truth[known]
        measures = {"position, ATE RMSE [m]": ate_rmse_m, "rotation, RMSE [deg]": turn_rmse_deg}
        return {name: (measure(before, truth), measure(after, truth)) for name, measure in measures.items()}


def close(
    odometry: np.ndarray,
    loops: Sequence[Loop],
    truth: np.ndarray | None = None,
    starts: Sequence[int] | np.ndarray = (),
    stamps: np.ndarray | None = None,
) -> Closed:
    """Close measured loops of a sequence of frames with odometry (F, 7), NaN for frames without; truth likewise.

    Loops are left out if they were not measured, or if one of their frames has no odometry. ``starts``: the first
    frames of the drives, if there are several; no step joins one with the drive before, and none is a jump of the
    odometry, which ``stamps`` (F,) in seconds help to find.
    """
    frames = np.flatnonzero(np.all(np.isfinite(odometry), axis=1))
    if len(frames) < 2:
        raise InputError(f"{len(frames)} of {len(odometry)} frames have a pose of the odometry; two are needed")
    path = odometry[frames]
    drive = pieces(odometry, stamps, starts)[frames]
    node = {int(frame): number for number, frame in enumerate(frames)}
    measured = [loop for loop in loops if loop.relative is not None]
    taken = [loop for loop in measured if {loop.query, loop.match} <= node.keys()]
    steps = [
        Edge(number, number + 1, step, information_of_step(step))
        for number, step in enumerate(steps_between(path))
        if drive[number] == drive[number + 1]
    ]
    edges = loop_edges(taken, node)
    solution = solve(path, steps, edges)
    known = None if truth is None else truth[frames]
    left_out = len(loops) - len(measured), len(measured) - len(taken)
    found = frames, path, solution.poses, steps, edges, taken, solution.accepted, left_out[0], known
    return Closed(*found, no_path=left_out[1], gaps=len(frames) - 1 - len(steps))


def loop_edges(loops: Sequence[Loop], node: Mapping[int, int] | range) -> list[Edge]:
    """Return the edges of the loops that were measured; ``node`` has the node of each frame."""
    return [Edge(node[x.match], node[x.query], *constraint(x.relative)) for x in loops if x.relative is not None]


def constraint(relative: Relative) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose (7,) and the information (6, 6) of a loop's edge.

    The information is the inverse of the covariance of ``relative`` and of the errors that its points have in common.
    If the length of the translation is not known, the information along its direction is 0, and the covariance is that
    of a translation of FAR_M. If only the rotation is known, the information of the whole translation is 0. So any
    program that reads g2o can use these edges.
    """
    common = np.linalg.inv((DEPTH_SIGMAS if relative.length_by == DEPTH else LOOP_SIGMAS).information())
    pose, scale = relative.pose.copy(), np.ones(6)
    known = np.eye(6)
    if relative.kind == ROTATION_ONLY:
        known = known[:, 3:]
    elif relative.kind == UP_TO_SCALE:
        known = across(Rotation.from_quat(pose[3:]).inv().apply(pose[:3]))  # g2o compares in the frame of the query
        scale[:3] = FAR_M
        common[:3, :3] += (FAR_M * RAY_RAD / relative.parallax) ** 2 * np.eye(3)
        pose[:3] = 0
    covariance = scale[:, None] * relative.covariance * scale + common
    return pose, known @ np.linalg.inv(known.T @ covariance @ known) @ known.T


def write_closed(out: Path, closed: Closed, stamps: np.ndarray | None, names: Sequence[str]) -> None:
    """Write closed.g2o, closed.txt and odometry.txt (TUM), and loops.csv with each loop and whether it was used.

    Without stamps, the frame numbers are written as seconds.
    """
    out.mkdir(parents=True, exist_ok=True)
    times = closed.frames.astype(float) if stamps is None else stamps[closed.frames]
    for name, poses in (("closed", closed.poses), ("odometry", closed.odometry)):
        write_trajectory(out / f"{name}.txt", times, poses, name)
    write_graph(out, closed, names)


def write_graph(out: Path, closed: Closed, names: Sequence[str]) -> None:
    """Write closed.g2o, and loops.csv with each loop and whether it was used; ``names`` (F) of all frames."""
    out.mkdir(parents=True, exist_ok=True)
    numbers = closed.frames.tolist()
    kept = [edge for edge, accepted in zip(closed.edges, closed.accepted, strict=True) if accepted]
    edges = [(numbers[e.first], numbers[e.second], e.pose, e.information) for e in [*closed.steps, *kept]]
    write_pose_graph(out / "closed.g2o", dict(zip(numbers, closed.poses, strict=True)), edges)
    rows = []
    for loop, accepted in zip(closed.loops, closed.accepted, strict=True):
        assert loop.relative is not None
        ends = (loop.query, loop.match)
        row = [*ends, *(names[i] for i in ends), loop.relative.kind, loop.relative.inliers]
        rows.append([*row, "yes" if accepted else "no"])
    head = ("query_id", "match_id", "query_name", "match_name", "measured", "inliers", "used")
    write_csv(out / "loops.csv", head, rows, "surrogateescape")


def summary(closed: Closed) -> list[str]:
    """Return sentences that summarize a closed path."""
    used = int(np.count_nonzero(closed.accepted))
    lines = [f"{used} of {len(closed.loops)} loops used, {len(closed.loops) - used} contradict the others"]
    if spot := one_spot(closed):
        lines.append(spot)
    if closed.not_measured:
        lines.append(f"{closed.not_measured} more left out: fewer than 20 points agree with one relative pose")
    if closed.no_path:
        lines.append(f"{closed.no_path} more left out: one of their frames has no odometry")
    if closed.gaps:
        lines.append(f"the odometry has {closed.gaps} gaps, where it jumps or another drive begins; loops bridge them")
    relatives = [loop.relative for loop in closed.loops if loop.relative is not None]
    for by, words in ((DEPTH, "depth"), (ODOMETRY, "steps of the odometry")):
        if count := sum(relative.length_by == by for relative in relatives):
            lines.append(f"{count} loops measured in meters, from {words}")
    meanings = {
        UP_TO_SCALE: "measured from color alone: a rotation, and the direction of the translation (up to scale)",
        ROTATION_ONLY: "give a rotation only: the camera turned and hardly moved, so the translation is undetermined",
    }
    for kind, words in meanings.items():
        if count := sum(relative.kind == kind for relative in relatives):
            lines.append(f"{count} loops {words}")
    errors = closed.errors()
    if errors is None:
        lines.append("error: not known without true poses")
    else:
        lines += [f"{what}: {before:.4g} before, {after:.4g} after" for what, (before, after) in errors.items()]
    return lines


Array = NDArray[np.float64]

# Simulated rotation error per meter and per percent of drift, in degrees.
DEGREES_PER_M = 0.1


def steps_between(poses: Array) -> Array:
    """Return the pose (N - 1, 7) of each of N poses (7,) in the frame of the previous one."""
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

    Each step gets a translation error of ``percent`` of its length, in a direction fixed in the camera, and a rotation
    error of ``percent`` of its rotation plus 0.1 degrees per meter and percent, about a fixed axis. These errors model
    a wrong calibration and accumulate. Each step also gets random noise of the same size, which mostly averages out.
    The direction, the axis and the noise depend on ``seed``.
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
    """Align poses (N, 7) with ``truth`` by one rigid motion: least squares over the positions of ``known`` (N,) poses.

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
    differences = aligned(path, truth, np.ones(len(path), bool))[:, :3] - truth[:, :3]
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=1))))


def turn_rmse_deg(path: Array, truth: Array) -> float:
    """Return the root mean square angle in degrees between the rotations of two paths, after aligning them."""
    a, b = (Rotation.from_quat(poses[:, 3:]) for poses in (path, truth))
    common = (b * a.inv()).mean()
    return float(np.degrees(np.sqrt(np.mean(((common * a).inv() * b).magnitude() ** 2))))


def one_spot(closed: Closed) -> str:
    """Say that all loops that are used lie in one spot, and how far from it the path goes; empty if they do not."""
    used = [edge for edge, accepted in zip(closed.edges, closed.accepted, strict=True) if accepted]
    if not used:
        return ""
    ends = np.array([(edge.first, edge.second) for edge in used])
    places = closed.poses[ends.ravel(), :3]
    middle = places.mean(axis=0)
    radius = np.linalg.norm(places - middle, axis=1).max()
    away = np.linalg.norm(closed.poses[ends.min() : ends.max() + 1, :3] - middle, axis=1).max()
    if radius > MAX_DISTANCE_M or away <= 2 * MAX_DISTANCE_M:
        return ""
    spot = f"all loops lie in one spot, within {max(radius, 0.01):.2g} m"
    return f"{spot}; the path between them goes up to {away:.3g} m away, where no loop corrects it"
