"""A pose graph that grows, solved by ISAM2: the path and the loops that are used are those of the whole graph."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopclosure.closing.close import ate_rmse_m, information_of_step, path_of, steps_between
from loopclosure.closing.graph import Edge, Solution, solve
from loopclosure.closing.incremental import IncrementalSolver
from loopclosure.detector.export import relative_pose

pytest.importorskip("gtsam")

LAP, NODES = 40, 120
LOOP = np.diag([100.0] * 3 + [2500.0] * 3)


def circles(short_deg: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """Three laps of 25 m: the true path (N, 7), and odometry that turns too little in each step."""
    angles = 2 * np.pi * np.arange(NODES) / LAP
    places = np.stack([4 * np.sin(angles), 4 - 4 * np.cos(angles), np.zeros(NODES)], axis=1)
    truth = np.hstack([places, Rotation.from_euler("z", angles[:, None]).as_quat()])
    steps = steps_between(truth)
    steps[:, 3:] = (Rotation.from_quat(steps[:, 3:]) * Rotation.from_euler("z", -short_deg, degrees=True)).as_quat()
    return truth, path_of(truth[0], steps)


def steps_of(path: np.ndarray, drives: tuple[int, ...] = ()) -> list[Edge]:
    steps = enumerate(steps_between(path))
    return [Edge(i, i + 1, step, information_of_step(step)) for i, step in steps if i + 1 not in drives]


def grown(path: np.ndarray, steps: list[Edge], loops: list[Edge]) -> Solution:
    """Solve the graph each time that it has a loop more."""
    solver, found = IncrementalSolver(), None
    for number in range(1, len(loops) + 1):
        nodes = max(edge.second for edge in loops[:number]) + 1
        found = solver.solve(path[:nodes], [step for step in steps if step.second < nodes], loops[:number])
        assert found.poses.shape == (nodes, 7)
        assert found.accepted.shape == (number,)
    assert found is not None
    return found


@pytest.mark.slow
def test_false_loops_among_right_ones_are_not_used_and_do_not_bend_the_path() -> None:
    truth, odometry = circles()
    pairs = [(second - LAP, second) for second in range(LAP, NODES, 4)]
    right = [Edge(i, j, relative_pose(truth[i], truth[j]), LOOP) for i, j in pairs]
    here = np.array([0, 0, 0, 0, 0, 0, 1.0])
    loops = sorted([*right, *(Edge(j - 20, j, here, LOOP) for j in (58, 75, 101))], key=lambda edge: edge.second)
    steps = steps_of(odometry)
    found, whole = grown(odometry, steps, loops), solve(odometry[:117], steps[:116], loops)
    assert found.accepted.tolist() == [edge.second - edge.first == LAP for edge in loops]
    assert found.accepted.tolist() == whole.accepted.tolist()
    np.testing.assert_allclose(found.poses[:, :3], whole.poses[:, :3], atol=0.02)
    assert ate_rmse_m(found.poses, truth[:117]) < 0.2 * ate_rmse_m(odometry[:117], truth[:117])


def test_a_loop_that_measures_its_rotation_or_a_direction_alone() -> None:
    truth, odometry = circles(0.1)
    turns, across = LOOP.copy(), LOOP.copy()
    turns[:3, :3] = across[0, 0] = 0
    loops = [
        Edge(second - LAP, second, relative_pose(truth[second - LAP], truth[second]), information)
        for second, information in zip(range(LAP, NODES, 8), [turns, across] * 5, strict=True)
    ]
    steps = steps_of(odometry)
    found = grown(odometry, steps, loops)
    nodes = len(found.poses)
    whole = solve(odometry[:nodes], steps[: nodes - 1], loops)
    assert found.accepted.all()
    np.testing.assert_allclose(found.poses[:, :3], whole.poses[:, :3], atol=0.02)


def test_another_drive_begins_anywhere_and_is_joined_by_its_loops() -> None:
    truth, odometry = circles()
    odometry[LAP:, :3] += [300, -20, 5]  # the wheels count from elsewhere
    steps = steps_of(odometry, (LAP,))
    pairs = [(second - LAP, second) for second in range(LAP + 5, 2 * LAP, 5)]
    loops = [Edge(i, j, relative_pose(truth[i], truth[j]), LOOP) for i, j in pairs]
    found = grown(odometry, steps, loops)
    assert found.accepted.all()
    whole = solve(odometry[:76], [step for step in steps if step.second < 76], loops)
    np.testing.assert_allclose(found.poses[:, :3], whole.poses[:, :3], atol=0.02)


def test_after_a_failure_it_begins_again_with_all_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, odometry = circles()
    steps, loop = steps_of(odometry), Edge(0, LAP, relative_pose(truth[0], truth[LAP]), LOOP)
    solver = IncrementalSolver()
    before = solver.solve(odometry, steps, [loop])
    with monkeypatch.context() as context:
        context.setattr(solver, "_path", lambda: (_ for _ in ()).throw(RuntimeError("indeterminate")))
        with pytest.raises(RuntimeError, match="indeterminate"):
            solver.solve(odometry, steps, [loop, loop])
    again = solver.solve(odometry, steps, [loop])
    np.testing.assert_allclose(again.poses, before.poses, atol=1e-3)
