"""``loopclosure close --graph``: pose graphs of thousands of poses, with true and false loops."""

import csv
import gzip
import re
import time
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse
from scipy.spatial.transform import Rotation

from loopclosure.cli import main
from loopclosure.closing import graph
from loopclosure.closing.close import ate_rmse_m, path_of, steps_between
from loopclosure.closing.g2o import read_pose_graph, solve_pose_graph
from loopclosure.closing.graph import Edge, least_squares_step, solve
from loopclosure.detector.export import relative_pose, write_pose_graph
from loopclosure.errors import InputError
from paths import shared

UPPER = np.triu_indices(6)


def entries(information: np.ndarray) -> str:
    return " ".join(f"{value:g}" for value in information[UPPER])


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


@pytest.mark.slow
def test_thousands_of_poses_take_few_steps_of_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """docs/closing.md has the time for 20,000 poses; this test counts what does not depend on other load."""
    truth, path, odometry, loops = drive(5000, 500, 100)
    sizes = []

    def step(derivatives: sparse.csr_matrix, errors: np.ndarray) -> np.ndarray:
        sizes.append(derivatives.nnz)
        return least_squares_step(derivatives, errors)

    monkeypatch.setattr(graph, "least_squares_step", step)
    found = solve(path, odometry, loops)
    assert len(sizes) < 40
    assert max(sizes) <= 72 * (len(odometry) + len(loops))
    assert not found.accepted[500:].any()
    assert found.accepted[:500].mean() > 0.95
    assert ate_rmse_m(found.poses, truth) < 0.5 * ate_rmse_m(path, truth)


def test_gtsam_computes_the_same_steps() -> None:
    pytest.importorskip("gtsam")
    _, path, odometry, loops = drive(600, 60, 12)
    graph_of = graph._Graph(len(path), [*odometry, *loops])
    state = graph.State(path[:, :3], Rotation.from_quat(path[:, 3:]))
    a, b = (least_squares_step(graph_of.derivatives(state), graph_of.errors(state), by) for by in (False, True))
    np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(a).max())


GRAPH = f"""# a square, driven against the clock
VERTEX_SE3:QUAT 40 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 7 5 5 5 0 0 0 2   # ids in any order, with gaps; a quaternion of any length
VERTEX_SE3:QUAT 12 6.5 5.2 5 0 0 0.7 0.7

EDGE_SE3:QUAT 7 12 1 0 0 0 0 0.70710678 0.70710678 {entries(np.eye(6))}
EDGE_SE3:QUAT 40 12 -1 1 0 0 0 -0.70710678 0.70710678 {entries(2 * np.eye(6))}
EDGE_SE3:QUAT 40 7 -1 0 0 0 0 -1 0 {entries(np.eye(6))}
FIX 7
"""


def close(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> tuple[str, list[list[str]]]:
    given = tmp_path / "in.g2o"
    given.write_text(text)
    assert main(["close", "--graph", str(given), "--out", str(tmp_path / "out")]) == 0, capsys.readouterr().err
    lines = [line.split() for line in (tmp_path / "out" / "closed.g2o").read_text().splitlines()]
    return capsys.readouterr().out, lines


@pytest.mark.slow
def test_comments_gaps_and_fixed_vertices(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said, lines = close(tmp_path, GRAPH, capsys)
    vertices = {int(words[1]): np.array(words[2:], float) for words in lines if words[0] == "VERTEX_SE3:QUAT"}
    assert list(vertices) == [7, 12, 40]
    np.testing.assert_allclose(vertices[7], [5, 5, 5, 0, 0, 0, 1], atol=1e-9)
    assert ["FIX", "7"] in lines
    read = read_pose_graph(tmp_path / "out" / "closed.g2o")
    assert (len(read.steps), len(read.loops)) == (2, 1)
    given = {edge.information[0, 0] for edge in read_pose_graph(tmp_path / "in.g2o").steps}
    assert given == {1.0, 2.0}  # the file's own
    assert "1 of 1 loops used, 0 contradict the others" in said
    with (tmp_path / "out" / "loops.csv").open() as stream:
        (row,) = csv.DictReader(stream)
    assert (row["first"], row["second"], row["used"]) == ("40", "7", "yes")
    assert (tmp_path / "out" / "paths.png").stat().st_size > 5000


def test_information_weighs_each_direction_of_each_edge(tmp_path: Path) -> None:
    """Two edges differ by 1 m along x and along y; each has more information along one axis."""
    weights = [np.diag([9, 1, 1, 1, 1, 1.0]), np.diag([1, 9, 1, 1, 1, 1.0])]
    ends = ["1 0 0", "0 1 0"]
    lines = ["VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1"]
    lines += [f"EDGE_SE3:QUAT 0 1 {at} 0 0 0 1 {entries(w)}" for at, w in zip(ends, weights, strict=True)]
    (tmp_path / "two.g2o").write_text("\n".join(lines))
    found = solve_pose_graph(read_pose_graph(tmp_path / "two.g2o"))
    np.testing.assert_allclose(found.poses[1, :3], [0.9, 0.9, 0], atol=1e-6)


def test_unconnected_parts_are_unchanged(tmp_path: Path) -> None:
    lines = [f"VERTEX_SE3:QUAT {i} {3 * i} 0 0 0 0 0 1" for i in range(4)]
    lines += [f"EDGE_SE3:QUAT {i} {i + 1} 1 0 0 0 0 0 1 {entries(np.eye(6))}" for i in (0, 2)]
    (tmp_path / "parts.g2o").write_text("\n".join(lines))
    found = solve_pose_graph(read_pose_graph(tmp_path / "parts.g2o"))
    np.testing.assert_allclose(found.poses[:, 0], [0, 1, 6, 7], atol=1e-6)


@pytest.mark.slow
def test_two_dimensions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corners = ["0 0 0", "1 0.2 1.5", "1.1 1 3", "0 0.8 -1.6"]
    lines = [f"VERTEX_SE2 {i} {at}" for i, at in enumerate(corners)]
    lines += [f"EDGE_SE2 {i} {(i + 1) % 4} 1 0 1.5707963268 100 0 0 100 0 400" for i in range(4)]
    _, written = close(tmp_path, "\n".join(lines), capsys)
    found = np.array([words[2:] for words in written if words[0] == "VERTEX_SE2"], float)
    np.testing.assert_allclose(found[:, :2], [[0, 0], [1, 0], [1, 1], [0, 1]], atol=1e-6)
    np.testing.assert_allclose(np.exp(1j * found[:, 2]), [1, 1j, -1, -1j], atol=1e-6)
    edges = [words[3:] for words in written if words[0] == "EDGE_SE2"]
    assert edges == [["1", "0", "1.57079633", "100", "0", "0", "100", "0", "400"]] * 4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("FIX 7", "FIX 8"), ":9:1: fixes vertex 8, which the file does not have"),
        (("QUAT 40 7", "QUAT 40 8"), ":8:1: the edge 40 8 ends at vertex 8, which the file does not have"),
        (("QUAT 40 7", "QUAT 40 40"), ":8:1: the edge 40 40 joins a vertex with itself"),
        (("FIX 7", "VERTEX_XY 1 2 3"), ":9:1: found VERTEX_XY; expected VERTEX_SE3:QUAT, EDGE_SE3:QUAT"),
        (("FIX 7", "VERTEX_SE2 1 2 3 4"), ": has vertices or edges of two and of three dimensions"),
        (("40 0 0 0 0 0 0 1", "40 0 0 0 0 0 0 nan"), ":2:1: found 8 words after VERTEX_SE3:QUAT; expected 8 numbers"),
        (("40 0 0 0 0 0 0 1", "40 0 0 0 0 0 0"), ":2:1: found 7 words after VERTEX_SE3:QUAT; expected 8 numbers"),
        (("40 0 0 0 0 0 0 1", "40 0 0 0 0 0 0 0"), ":2:1: the quaternion is 0"),
        (("QUAT 12 6.5", "QUAT 7 6.5"), ":4:1: there is a vertex 7 already"),
        ((entries(2 * np.eye(6)), entries(-np.eye(6))), ":7:1: the information matrix has a negative eigenvalue, -1"),
    ],
)
def test_errors_of_the_file_are_reported(tmp_path: Path, change: tuple[str, str], said: str) -> None:
    path = tmp_path / "in.g2o"
    path.write_text(GRAPH.replace(*change))
    with pytest.raises(InputError, match=re.escape(said)):
        read_pose_graph(path)


def test_other_options_are_refused_for_a_graph(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["close", "--graph", "in.g2o", "--out", str(tmp_path)]
    assert main([*line, "--loops", "l.csv"]) == 2
    assert "--loops cannot be used with --graph" in capsys.readouterr().err
    assert main(["close", "--out", str(tmp_path)]) == 2
    assert "expected the frames and --loops, or --graph" in capsys.readouterr().err


@pytest.mark.parametrize("flat", [False, True])
def test_edges_alone_are_chained(tmp_path: Path, flat: bool) -> None:
    """As in SE-Sync's data sets: odometry in both directions, and a vertex that only a loop reaches."""
    truth = street(120)
    truth[:, 2] = 0
    truth[:, 3:] = Rotation.from_rotvec(0.1 * np.arange(120)[:, None] * [0, 0, 1]).as_quat()
    ends = [(i, i + 1) if i % 3 else (i + 1, i) for i in range(119) if i != 60] + [(0, 80), (20, 100)]
    edges = [(3 * i, 3 * j, relative_pose(truth[i], truth[j]), np.eye(6)) for i, j in ends]
    write_pose_graph(tmp_path / "edges.g2o", {}, edges, flat=flat)
    read = read_pose_graph(tmp_path / "edges.g2o")
    np.testing.assert_array_equal(read.ids, np.arange(0, 360, 3))
    np.testing.assert_allclose(read.poses[:, :3], truth[:, :3] - truth[0, :3], atol=1e-5)
    assert solve_pose_graph(read).accepted.all()


@pytest.mark.parametrize(("flat", "error", "used"), [(True, 3.3, "yes"), (True, 3.5, "no"), (False, 3.5, "yes")])
def test_a_true_loop_is_within_the_limit_of_its_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flat: bool, error: float, used: str
) -> None:
    """99 of 100 squares are below 11.34 of three numbers, 16.81 of six; --loops all rejects none."""
    step = np.array([1, 0, 0, 0, 0, 0, 1.0])
    edges = [(i, i + 1, step, 1e8 * np.eye(6)) for i in range(4)]
    edges.append((0, 4, step * (4 + error) - np.array([0, 0, 0, 0, 0, 0, 3 + error]), np.eye(6)))
    write_pose_graph(tmp_path / "in.g2o", {}, edges, flat=flat)
    for words, expected in (([], used), (["--loops", "all"], "yes")):
        line = ["close", "--graph", str(tmp_path / "in.g2o"), "--out", str(tmp_path / "out"), *words]
        assert main(line) == 0, capsys.readouterr().err
        with (tmp_path / "out" / "loops.csv").open() as stream:
            assert [row["used"] for row in csv.DictReader(stream)] == [expected]


@pytest.mark.slow
def test_the_parking_garage(tmp_path: Path) -> None:
    """Carlone et al., ICRA 2015: 1,661 poses, 6,275 edges; the least chi-squared is 1.268. No loop is false."""
    packed = shared("data/pose_graphs/parking-garage.g2o.gz")
    path = tmp_path / "garage.g2o"
    path.write_bytes(gzip.decompress(packed.read_bytes()))
    given = read_pose_graph(path)
    begun = time.process_time()
    found = solve_pose_graph(given)
    assert time.process_time() - begun < 30  # 1 to 2 where nothing else runs
    assert found.accepted.all()
    assert found.odometry_squares.sum() + found.squares.sum() == pytest.approx(1.26838, abs=1e-4)
    path.write_text("\n".join(line for line in path.read_text().splitlines() if line.startswith("EDGE")))
    alone = solve_pose_graph(read_pose_graph(path), all_true=True)
    assert alone.odometry_squares.sum() + alone.squares.sum() == pytest.approx(1.26838, abs=1e-4)
