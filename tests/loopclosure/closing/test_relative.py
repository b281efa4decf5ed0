"""The relative pose of two views, its covariance, and its edge in a pose graph."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopclosure.closing.close import DEPTH_SIGMAS, FAR_M, RAY_RAD, close, constraint
from loopclosure.closing.length import neighbors, with_length
from loopclosure.closing.measure import Loop, cells, errors_said
from loopclosure.closing.relative import METRIC, ROTATION_ONLY, UP_TO_SCALE, Relative, View, across, relative_view
from loopclosure.detector.export import LOOP_SIGMAS, RELATIVE, relative_pose
from loopclosure.detector.verification import LocalFeatures
from loopclosure.places.depth import depth_at
from loopclosure.places.intrinsics import Intrinsics

CAMERA = Intrinsics(260, 262, 159.5, 119.5)
POINTS = 120
WRONG = 30
TURN = Rotation.from_euler("yx", [8, -3], degrees=True)


def views(step: np.ndarray, depth: bool = False) -> tuple[View, View, np.ndarray]:
    """Two views of points at 2 to 6 m; the second camera is moved by ``step``. A quarter does not match."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -1.5, 2], [2, 1.5, 6], (POINTS, 3))
    pixels, maps = [], []
    for seen in (points, TURN.inv().apply(points - step)):
        at = seen[:, :2] / seen[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
        pixels.append((at + rng.normal(0, 0.3, at.shape)).astype(np.float32))
        # Each point on a small patch of its own depth, as of a surface; where patches meet, depth is not used.
        image = np.zeros((240, 320), np.float32)
        for (x, y), z in zip(np.rint(at).astype(int), seen[:, 2], strict=True):
            image[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] = z
        maps.append(depth_at(image, pixels[-1]) if depth else None)
    matches = np.stack([np.arange(POINTS)] * 2, axis=1)
    matches[:WRONG, 1] = np.roll(matches[:WRONG, 1], 7)
    none = np.zeros((POINTS, 128), np.uint8)
    first, second = (View(LocalFeatures(at, none), CAMERA, z) for at, z in zip(pixels, maps, strict=True))
    return first, second, matches


def degrees_off(pose: np.ndarray) -> float:
    return float(np.degrees((TURN.inv() * Rotation.from_quat(pose[3:])).magnitude()))


def test_depth_gives_meters() -> None:
    step = np.array([0.4, -0.1, 0.3])
    first, second, matches = views(step, depth=True)
    for one, other in ((first, second), (first, View(second.local, CAMERA)), (View(first.local, CAMERA), second)):
        found = relative_view(one, other, matches)
        assert found is not None
        assert found.kind == METRIC
        np.testing.assert_allclose(found.pose[:3], step, atol=0.03)
        assert degrees_off(found.pose) < 0.5


def test_color_gives_the_direction_without_the_length() -> None:
    step = np.array([0.4, -0.1, 0.3])
    found = relative_view(*views(step))
    assert found is not None
    assert found.kind == UP_TO_SCALE
    assert np.linalg.norm(found.pose[:3]) == pytest.approx(1)
    assert found.pose[:3] @ step / np.linalg.norm(step) > np.cos(np.radians(5))
    assert degrees_off(found.pose) < 0.5
    assert found.inliers >= 80


def test_a_camera_that_only_turned_gives_a_rotation_only() -> None:
    found = relative_view(*views(np.zeros(3)))
    assert found is not None
    assert found.kind == ROTATION_ONLY
    assert found.pose[:3].tolist() == [0, 0, 0]
    assert degrees_off(found.pose) < 0.2


def test_inconsistent_points_give_no_motion() -> None:
    first, second, matches = views(np.array([0.4, 0, 0]))
    assert relative_view(first, second, matches[:19]) is None
    scrambled = np.stack([matches[:, 0], np.random.default_rng(1).permutation(POINTS)], axis=1)
    assert relative_view(first, second, scrambled) is None


def seen(pose: np.ndarray, rng: np.random.Generator, noise: float, depth: str = "") -> tuple[View, View, np.ndarray]:
    """Two views of 80 points, the query at ``pose`` in the frame of the match; ``depth``: which of them has it."""
    points = rng.uniform([-2, -1.5, 2], [2, 1.5, 6], (80, 3))
    made = []
    for name, there in (("match", points), ("query", Rotation.from_quat(pose[3:]).inv().apply(points - pose[:3]))):
        at = there[:, :2] / there[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
        if not depth or depth != name:  # the error is of the pixels that are compared with a projection
            at = at + rng.normal(0, noise, at.shape)
        made.append(
            View(LocalFeatures(at, np.zeros((80, 128), np.uint8)), CAMERA, there[:, 2] if depth == name else None)
        )
    return made[0], made[1], np.stack([np.arange(80)] * 2, axis=1)


@pytest.mark.parametrize(
    ("kind", "depth", "step", "noise"),
    [
        (METRIC, "match", (0.4, -0.1, 0.3), 0.5),
        (METRIC, "query", (0.4, -0.1, 0.3), 0.5),
        (UP_TO_SCALE, "", (0.4, -0.1, 0.3), 0.7),
        (ROTATION_ONLY, "", (0, 0, 0), 0.5),
    ],
)
def test_the_covariance_is_that_of_the_errors(kind: str, depth: str, step: tuple[float, ...], noise: float) -> None:
    """The squared error by its covariance is as large as the number of what is measured, on the average."""
    rng = np.random.default_rng(4)
    true = np.array([*step, *TURN.as_quat()])
    squares = []
    for _ in range(40):
        found = relative_view(*seen(true, rng, noise, depth))
        assert found is not None
        assert found.kind == kind
        assert found.length_by == ("depth" if depth else "")
        whole = true.copy()
        if kind == UP_TO_SCALE:
            whole[:3] /= np.linalg.norm(step)
        off = relative_pose(found.pose, whole)
        error = np.concatenate([off[:3], Rotation.from_quat(off[3:]).as_rotvec()])
        free = np.eye(6)[:, 3:] if kind == ROTATION_ONLY else np.eye(6)
        if kind == UP_TO_SCALE:
            free = across(Rotation.from_quat(found.pose[3:]).inv().apply(found.pose[:3]))
        assert np.linalg.matrix_rank(found.covariance, 1e-12, hermitian=True) == free.shape[1]
        measured = free.T @ error
        squares.append(measured @ np.linalg.solve(free.T @ found.covariance @ free, measured) / free.shape[1])
    assert 0.6 < np.mean(squares) < 1.6


def test_the_edge_of_a_loop_has_its_information() -> None:
    rng = np.random.default_rng(5)
    true = np.array([0.4, -0.1, 0.3, *TURN.as_quat()])
    metric, scaled = (relative_view(*seen(true, rng, 0.5, depth)) for depth in ("match", ""))
    turned = relative_view(*seen(np.array([0, 0, 0, *TURN.as_quat()]), rng, 0.5))
    assert metric is not None
    assert scaled is not None
    assert turned is not None
    pose, information = constraint(metric)
    np.testing.assert_array_equal(pose, metric.pose)
    common = np.linalg.inv(DEPTH_SIGMAS.information())
    np.testing.assert_allclose(np.linalg.inv(information), metric.covariance + common, rtol=1e-6, atol=1e-9)
    pose, information = constraint(scaled)
    along = Rotation.from_quat(pose[3:]).inv().apply(scaled.pose[:3])
    assert pose[:3].tolist() == [0, 0, 0]
    np.testing.assert_allclose(information[:3] @ np.append(along, np.zeros(3)), 0, atol=1e-6)
    assert np.linalg.matrix_rank(information, 1e-3, hermitian=True) == 5
    side = np.append(np.cross(along, [0, 0, 1.0]) / np.linalg.norm(np.cross(along, [0, 0, 1.0])), np.zeros(3))
    spread = 1 / np.sqrt(side @ information @ side)
    off = np.hypot(np.sqrt(side @ scaled.covariance @ side), RAY_RAD / scaled.parallax)
    assert spread < np.hypot(LOOP_SIGMAS.translation_m, FAR_M * off)
    pose, information = constraint(turned)
    assert not information[:3].any()
    assert not information[:, :3].any()
    turns = np.linalg.inv(information[3:, 3:])
    np.testing.assert_allclose(turns, turned.covariance[3:, 3:] + LOOP_SIGMAS.rotation_rad**2 * np.eye(3), atol=1e-9)


@pytest.mark.parametrize("parallax", [0.01, 0.1, np.inf])
def test_a_direction_is_as_uncertain_as_its_parallax_is_small(parallax: float) -> None:
    scaled = Relative(np.array([1.0, 0, 0, 0, 0, 0, 1]), UP_TO_SCALE, 40, np.zeros((6, 6)), parallax=parallax)
    _, information = constraint(scaled)
    shift = np.hypot(0.1, 0.5 * 0.05 / 12**0.5 / parallax)
    np.testing.assert_allclose(information, np.diag([0, *[shift**-2] * 2, *[0.05**-2] * 3]), atol=1e-9)


def test_the_parallax_is_what_a_rotation_does_not_explain() -> None:
    near, far = (relative_view(*views(np.array([0.4, -0.1, 0.3]) * times)) for times in (1, 2))
    assert near is not None
    assert far is not None
    assert 2 / 261 < near.parallax < far.parallax < 0.1


def test_directions_that_are_noise_do_not_move_a_camera_that_turned_in_place() -> None:
    """Rolling shutters make the same wrong direction in all loops, so their number must not count."""
    times = np.linspace(0, 20, 300)
    place = 0.04 * np.stack([np.sin(times), np.cos(1.3 * times), np.sin(0.7 * times)], axis=1)
    truth = np.hstack([place, Rotation.from_euler("y", 20 * np.sin(times)[:, None], degrees=True).as_quat()])
    loops = []
    for query in range(150, 300):
        pose = relative_pose(truth[query - 120], truth[query])
        pose[:3] = 0, 1, 0
        loops.append(Loop(query, query - 120, Relative(pose, UP_TO_SCALE, 60, np.zeros((6, 6)), parallax=0.01)))
    errors = close(truth, loops, truth).errors()
    assert errors is not None
    assert errors["position, ATE RMSE [m]"][1] < 0.001  # 0.006 if parallax did not count


def three(step: np.ndarray) -> tuple[list[View], Any]:
    """A match, a query and a neighbor of the match at ``step`` (3,) from it; all see the same 80 points."""
    rng = np.random.default_rng(8)
    points = rng.uniform([-2, -1.5, 2], [2, 1.5, 6], (80, 3))
    made = []
    for place, turn in ((np.zeros(3), Rotation.identity()), (np.array([0.4, -0.1, 0.3]), TURN), (step, TURN.inv())):
        there = turn.inv().apply(points - place)
        at = there[:, :2] / there[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
        at = at + rng.normal(0, 0.3, at.shape)
        made.append(View(LocalFeatures(at, np.zeros((80, 128), np.uint8)), CAMERA))
    return made, lambda a, b: np.stack([np.arange(80)] * 2, axis=1)


@pytest.mark.parametrize("end", [0, 1])
def test_a_step_of_the_odometry_gives_the_length(end: int) -> None:
    """The neighbor of the match, and, where the loop is turned around, that of the query."""
    (match, query, neighbor), matching = three(np.array([-0.2, 0.1, 0.1]))
    views = (match, query) if end == 0 else (query, match)
    scaled = relative_view(*views, matching(match.local, query.local))
    assert scaled is not None
    assert scaled.kind == UP_TO_SCALE
    matches = matching(views[0].local, views[1].local)
    near: list[list[tuple[View, float]]] = [[], []]
    assert with_length(scaled, views, matches, (near[0], near[1]), matching) is scaled
    near[end] = [(views[end], 0.5), (neighbor, 0.06**0.5)]  # the first did not move
    found = with_length(scaled, views, matches, (near[0], near[1]), matching)
    assert (found.kind, found.length_by) == (METRIC, "odometry")
    assert np.linalg.norm(found.pose[:3]) == pytest.approx(0.26**0.5, rel=0.06)
    along = Rotation.from_quat(found.pose[3:]).inv().apply(found.pose[:3])
    along /= np.linalg.norm(along)
    assert along @ found.covariance[:3, :3] @ along > (0.02 * 0.26**0.5) ** 2


def test_neighbors_are_a_step_away_by_the_odometry() -> None:
    odometry = np.zeros((30, 7))
    odometry[:, 0] = 0.061 * np.arange(30)
    odometry[4] = np.nan
    assert [number for number, _ in neighbors(odometry, 6, np.zeros(30))] == [1, 11, 3, 8]
    assert [number for number, _ in neighbors(odometry, 6, np.arange(30) // 6)] == [11, 8]
    assert dict(neighbors(odometry, 6, np.zeros(30)))[1] == pytest.approx(0.305)
    assert neighbors(np.zeros((30, 7)), 6, np.zeros(30)) == []
    assert neighbors(odometry, 4, np.zeros(30)) == []


def test_a_measured_loop_is_a_row_of_the_table_and_judged_by_true_poses() -> None:
    true = np.array([[0, 0, 0, 0, 0, 0, 1.0], [3, 0, 4, *TURN.as_quat()]])
    turned = (TURN * Rotation.from_euler("y", 2, degrees=True)).as_quat()
    covariance = np.diag([0.01**2] * 3 + [np.deg2rad(0.3) ** 2] * 3)
    metric = Relative(np.array([3, 0, 4.1, *TURN.as_quat()]), METRIC, 60, covariance, "depth")
    scaled = Relative(np.array([0.6, 0, 0.8, *turned]), UP_TO_SCALE, 40, covariance)
    turn = Relative(np.array([0, 0, 0, *TURN.as_quat()]), ROTATION_ONLY, 50, covariance)
    rows = [dict(zip(RELATIVE, cells(each), strict=True)) for each in (metric, scaled, turn)]
    assert [row["length_m"] for row in rows] == ["5.080354", "", ""]
    assert [(row["dx"], row["dz"]) for row in rows] == [("0.590510", "0.807030"), ("0.600000", "0.800000"), ("", "")]
    assert [(row["sigma_m"], row["sigma_deg"]) for row in rows] == [("0.01", "0.3"), ("", "0.3"), ("", "0.3")]
    assert [row["length_by"] for row in rows] == ["depth", "", ""]
    entries = np.array(str(rows[0]["covariance"]).split(), float)
    np.testing.assert_allclose(entries, covariance[np.triu_indices(6)], rtol=1e-5)
    assert [row["agreeing"] for row in rows] == [60, 40, 50]
    loops = [Loop(1, 0, each) for each in (metric, scaled, turn, None)]
    said = errors_said(loops, true)
    assert said.startswith("median errors of the 3 measured loops, by the true poses: rotation ")
    assert said.endswith(" degrees, direction 0.34 degrees (of 2), translation 0.1 m (of 1)")
    assert "rotation 2 degrees, direction" in errors_said([loops[1]], true)
    assert errors_said(loops, np.full((2, 7), np.nan)) == ""
