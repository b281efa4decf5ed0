"""The pose graph: correct derivatives, loops that correct drift, and false loops that do no harm."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopclosure.closing.close import (
    Closed,
    aligned,
    ate_rmse_m,
    drifted,
    one_spot,
    path_of,
    steps_between,
    turn_rmse_deg,
)
from loopclosure.closing.graph import Edge, State, _Graph, solve
from loopclosure.detector.export import LOOP_SIGMAS, relative_pose
from loopclosure.errors import InputError
from loopclosure.places.intrinsics import Intrinsics, from_text

LAPS, PER_LAP = 3, 40


def laps() -> np.ndarray:
    """Poses (120, 7) of three rounds of 8 x 5 m."""
    turn = np.arange(LAPS * PER_LAP) * 2 * np.pi / PER_LAP
    places = np.stack([8 * np.cos(turn), 5 * np.sin(turn), 0.2 * np.sin(3 * turn)], axis=1)
    angles = np.stack([turn, 0.1 * np.sin(5 * turn)], axis=1)
    return np.hstack([places, Rotation.from_euler("zx", angles).as_quat()])


def odometry_edges(path: np.ndarray) -> list[Edge]:
    sigmas = np.array([0.02] * 3 + [0.005] * 3)
    return [Edge(i, i + 1, step, np.diag(sigmas**-2.0)) for i, step in enumerate(steps_between(path))]


def loop_edges(truth: np.ndarray, every: int = 5) -> list[Edge]:
    pairs = [(i, i + PER_LAP + 1) for i in range(0, len(truth) - PER_LAP - 1, every)]
    return [Edge(i, j, relative_pose(truth[i], truth[j]), LOOP_SIGMAS.information()) for i, j in pairs]


def test_derivatives_equal_numerical_ones() -> None:
    rng = np.random.default_rng(0)
    poses = np.hstack([rng.normal(size=(5, 3)), Rotation.random(5, rng).as_quat()])
    measured = np.hstack([rng.normal(size=(3, 3)), Rotation.random(3, rng).as_quat()])
    information = [np.eye(6), np.diag([1, 2, 0, 3, 4, 5.0]), np.diag(rng.uniform(1, 9, 6))]
    edges = [Edge(*ends, measured[k], information[k]) for k, ends in enumerate([(0, 1), (3, 2), (4, 0)])]
    graph = _Graph(len(poses), edges)
    start = State(poses[:, :3], Rotation.from_quat(poses[:, 3:]))
    # The graph has two parts, 0 1 4 and 2 3; the first node of each stays.
    steps = 1e-6 * np.eye(18)
    state = graph.moved(start, rng.normal(0, 0.3, 18))
    there, back = ([graph.errors(graph.moved(state, way * step)) for step in steps] for way in (1, -1))
    numeric = (np.stack(there, axis=1) - np.stack(back, axis=1)) / 2e-6
    np.testing.assert_allclose(graph.derivatives(state).toarray(), numeric, atol=1e-7)


def test_loops_correct_the_drift() -> None:
    truth = laps()
    path = drifted(truth, 2, seed=1)
    solution = solve(path, odometry_edges(path), loop_edges(truth))
    assert ate_rmse_m(path, truth) > 0.3
    assert ate_rmse_m(solution.poses, truth) < 0.3 * ate_rmse_m(path, truth)
    assert solution.accepted.all()
    np.testing.assert_allclose(solution.poses[0], path[0], atol=1e-9)


def test_drift_follows_from_its_seed_and_grows_with_its_size() -> None:
    truth = laps()
    np.testing.assert_array_equal(drifted(truth, 2, seed=5), drifted(truth, 2, seed=5))
    assert not np.array_equal(drifted(truth, 2, seed=5), drifted(truth, 2, seed=6))
    errors = [ate_rmse_m(drifted(truth, percent, seed=5), truth) for percent in (0.5, 1, 2)]
    assert errors[0] < errors[1] < errors[2]
    with pytest.raises(InputError, match="a drift of 0 %; expected a number above 0"):
        drifted(truth, 0, seed=5)


def test_steps_and_errors_of_a_path() -> None:
    truth = laps()
    np.testing.assert_allclose(path_of(truth[0], steps_between(truth))[:, :3], truth[:, :3], atol=1e-9)
    turn = Rotation.from_euler("xyz", [0.3, -0.5, 2.0])
    elsewhere = np.hstack([turn.apply(truth[:, :3]), (turn * Rotation.from_quat(truth[:, 3:])).as_quat()])
    elsewhere[:, :3] += np.array([5, 6, 7])
    assert ate_rmse_m(elsewhere, truth) == pytest.approx(0, abs=1e-9)
    assert turn_rmse_deg(elsewhere, truth) == pytest.approx(0, abs=1e-5)
    known = np.arange(len(truth)) % 2 == 0
    np.testing.assert_allclose(aligned(elsewhere, truth, known)[:, :3], truth[:, :3], atol=1e-9)
    wide = truth.copy()
    wide[:, :3] *= 1.1
    size = np.sqrt(np.mean(np.sum((truth[:, :3] - truth[:, :3].mean(axis=0)) ** 2, axis=1)))
    assert ate_rmse_m(wide, truth) == pytest.approx(0.1 * size)


def test_the_camera_of_smaller_images_and_of_text() -> None:
    camera = from_text("517.3,516.5,318.6,255.3,0.26,-0.95,-0.005,0.003,1.16")
    assert camera.distortion == (0.26, -0.95, -0.005, 0.003, 1.16)
    assert camera.of_size(320, 240) == camera  # of which size it is, is not known
    full = Intrinsics(520, 520, 319.5, 239.5, size=(640, 480))
    half = full.of_size(320, 240)
    assert (half.fx, half.cx, half.cy) == (260, 159.5, 119.5)
    np.testing.assert_allclose(full.rays(np.array([[639.5, 239.5]])), half.rays(np.array([[319.5, 119.5]])))
    for wrong in ("517,516", "a,b,c,d", "0,1,2,3"):
        with pytest.raises(InputError):
            from_text(wrong)


@pytest.mark.parametrize(("ends", "spot"), [([(0, 40), (1, 39)], True), ([(0, 40), (15, 25)], False), ([], False)])
def test_loops_at_one_position_are_reported(ends: list[tuple[int, int]], spot: bool) -> None:
    """A path of 20 m and back, with loops only at its beginning, or also in the middle."""
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (41, 1))
    poses[:, 0] = 20 - np.abs(np.arange(41) - 20)
    edges = [Edge(first, second, poses[0], np.eye(6)) for first, second in ends]
    closed = Closed(np.arange(41), poses, poses, [], edges, [], np.ones(len(edges), bool), 0)
    assert ("the path between them goes up to 19.5 m away" in one_spot(closed)) == spot
