"""Pose graphs of thousands of poses, with true and false loops."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphs import read_graph
from loopclosure.closing import graph
from loopclosure.closing.close import path_of, steps_between
from loopclosure.closing.graph import Edge, least_squares_step, solve
from loopclosure.detector.export import STILL, relative_pose
from paths import shared


def street(poses: int, seed: int = 0) -> np.ndarray:
    """Poses (N, 7) of a drive through blocks of 20 m, one every 0.5 m, which returns to earlier places many times."""
    rng = np.random.default_rng(seed)
    cell, heading, corners = np.zeros(2, int), 0, [np.zeros(2, int)]
    ways = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    while len(corners) < poses // 40 + 2:
        turn = next(t for t in (rng.choice([-1, 0, 1]), 1, -1, 2) if np.abs(cell + ways[(heading + t) % 4]).max() <= 6)
        heading = (heading + turn) % 4
        cell = cell + ways[heading]
        corners.append(cell)
    along = np.arange(poses) / 40
    places = np.stack([np.interp(along, range(len(corners)), column) for column in 20.0 * np.array(corners).T], axis=1)
    ahead = np.diff(np.array(corners), axis=0)[along.astype(int)]
    turns = np.stack([np.arctan2(ahead[:, 1], ahead[:, 0]), 0.02 * np.sin(along), 0.02 * np.cos(along)], axis=1)
    return np.hstack([places, 0.3 * np.sin(places[:, :1] / 17), Rotation.from_euler("zyx", turns).as_quat()])


def noisy(pose: np.ndarray, sigmas: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    turn = Rotation.from_quat(pose[3:]) * Rotation.from_rotvec(rng.normal(0, sigmas[1], 3))
    return np.concatenate([pose[:3] + rng.normal(0, sigmas[0], 3), turn.as_quat(canonical=True)])


def drive(poses: int, loops: int, false: int) -> tuple[np.ndarray, np.ndarray, list[Edge], list[Edge]]:
    """The true path, the odometry, its steps, and loops; the last ``false`` loops join random places."""
    rng = np.random.default_rng(1)
    truth = street(poses)
    steps = np.array([noisy(step, (0.02, 0.005), rng) for step in steps_between(truth)])
    odometry = [Edge(i, i + 1, step, np.diag([2500] * 3 + [40000.0] * 3)) for i, step in enumerate(steps)]
    seen: dict[tuple[int, ...], list[int]] = {}
    for number, place in enumerate(np.rint(truth[:, :2] / 0.5).astype(int)):
        seen.setdefault(tuple(place), []).append(number)
    pairs = np.array([(ends[0], end) for ends in seen.values() for end in ends[1:] if end - ends[0] > 100])
    pairs = pairs[rng.choice(len(pairs), loops, replace=False)]
    information = np.diag([100.0] * 3 + [400.0] * 3)
    right = [Edge(i, j, noisy(relative_pose(truth[i], truth[j]), (0.1, 0.05), rng), information) for i, j in pairs]
    nothing = np.array([0, 0, 0, 0, 0, 0, 1.0])
    wrong: list[Edge] = []
    while len(wrong) < false:
        i, j = sorted(rng.choice(poses, 2, replace=False).tolist())
        if np.linalg.norm(truth[i, :3] - truth[j, :3]) > 5:
            wrong.append(Edge(i, j, noisy(nothing, (0.1, 0.05), rng), information))
    return truth, path_of(truth[0], steps), odometry, [*right, *wrong]


@pytest.mark.slow
def test_a_drive_with_a_fifth_of_its_loops_false() -> None:
    _, path, odometry, loops = drive(1500, 150, 30)
    clean, found = solve(path, odometry, loops[:150]), solve(path, odometry, loops)
    assert not found.accepted[150:].any()
    assert found.accepted[:150].mean() > 0.95
    np.testing.assert_allclose(found.poses[:, :3], clean.poses[:, :3], atol=0.05)


def test_gtsam_computes_the_same_steps() -> None:
    pytest.importorskip("gtsam")
    _, path, odometry, loops = drive(600, 60, 12)
    graph_of = graph._Graph(len(path), [*odometry, *loops])
    state = graph.State(path[:, :3], Rotation.from_quat(path[:, 3:]))
    a, b = (least_squares_step(graph_of.derivatives(state), graph_of.errors(state), by) for by in (False, True))
    np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(a).max())


def test_unconnected_parts_are_unchanged() -> None:
    poses = np.tile(STILL, (4, 1))
    poses[:, 0] = 0, 3, 6, 9
    found = solve(poses, [Edge(i, i + 1, np.array([1.0, 0, 0, 0, 0, 0, 1]), np.eye(6)) for i in (0, 2)], [])
    np.testing.assert_allclose(found.poses[:, 0], [0, 1, 6, 7], atol=1e-6)


@pytest.mark.parametrize(("error", "used"), [(4.0, True), (4.2, False)])
def test_a_true_loop_is_within_the_limit_of_its_numbers(error: float, used: bool) -> None:
    """99 of 100 squares of six numbers are below 16.81."""
    step = np.array([1, 0, 0, 0, 0, 0, 1.0])
    poses = np.tile(STILL, (5, 1))
    poses[:, 0] = np.arange(5)
    loop = Edge(0, 4, np.array([4 + error, 0, 0, 0, 0, 0, 1]), np.eye(6))
    found = solve(poses, [Edge(i, i + 1, step, 1e8 * np.eye(6)) for i in range(4)], [loop])
    assert found.accepted.tolist() == [used]


@pytest.mark.parametrize("written", [False, True])
def test_a_direction_that_is_not_measured_is_no_number(written: bool) -> None:
    """Also after the rounding of a file: 15.09 of five numbers, 16.81 of six."""
    rng = np.random.default_rng(0)
    edges = []
    for _ in range(100):
        across = np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :5]
        spread = rng.normal(size=(5, 5)) * 10 ** rng.uniform(-3.5, -1.5, 5)
        information = across @ np.linalg.inv(spread @ spread.T + 1e-5 * np.eye(5)) @ across.T
        rounded = np.array([float(f"{value:.9g}") for value in information.ravel()]).reshape(6, 6)
        edges.append(Edge(0, 1, STILL, rounded if written else information))
    np.testing.assert_allclose(graph.limits_of(edges), 15.086, atol=0.001)


@pytest.mark.slow
def test_the_parking_garage(tmp_path: Path) -> None:
    """Carlone et al., ICRA 2015: 1,661 poses, 6,275 edges; the least chi-squared is 1.268. No loop is false."""
    packed = shared("data/pose_graphs/parking-garage.g2o.gz")
    path = tmp_path / "garage.g2o"
    path.write_bytes(gzip.decompress(packed.read_bytes()))
    vertices, edges = read_graph(path)
    ids = sorted(vertices)
    assert ids == list(range(len(ids)))
    steps, loops = ([e for e in edges if (abs(e.first - e.second) == 1) == step] for step in (True, False))
    found = solve(np.array([vertices[number] for number in ids]), steps, loops)
    assert found.accepted.all()
    assert found.odometry_squares.sum() + found.squares.sum() == pytest.approx(1.26838, abs=1e-4)
