"""``loopclosure close`` on the synthetic walk, with its true poses and depth, and with one false loop added."""

import csv
import io
import re
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.cli import main
from loopclosure.closing.close import close as close_path
from loopclosure.closing.measure import Loop, depth_scale_said, measure, read_loops
from loopclosure.closing.relative import METRIC, Relative
from loopclosure.detector.export import relative_pose
from loopclosure.errors import InputError
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.pose_files import read_poses
from loopclosure.places.same_place import same_place_matrix
from loopclosure.places.sequences import read_sequence

pytestmark = pytest.mark.slow

FRAMES = 90


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two laps of a house, with depth, and a table of some of its true loops."""
    folder = tmp_path_factory.mktemp("close") / "walk"
    for _ in write_walk(folder, Walk(frames=FRAMES, width=240, height=180, laps=2, seed=11, depth=True)):
        pass
    poses = read_sequence(folder).with_poses().known_poses()
    same = np.tril(same_place_matrix(poses, poses, 0.4, 12), -20)
    rows = [f"{i},{int(np.argmax(same[i]))}" for i in np.flatnonzero(same.any(axis=1))]
    assert len(rows) > 12
    (folder.parent / "loops.csv").write_text("query_id,match_id\n" + "\n".join(rows) + "\n")
    return folder


def close(folder: Path, loops: Path, out: Path) -> str:
    """Close the loops of a sequence; return what the command prints."""
    line = ["close", str(folder), "--loops", str(loops), "--drift", "2", "--seed", "3", "--out", str(out)]
    with redirect_stdout(io.StringIO()) as printed:
        assert main(line) == 0
    return printed.getvalue()


@pytest.fixture(scope="module")
def closed(walk: Path) -> tuple[str, Path]:
    """What the command prints where it closes the walk, and the folder that it writes."""
    out = walk.parent / "closed"
    return close(walk, walk.parent / "loops.csv", out), out


def errors(said: str) -> tuple[float, float]:
    found = re.search(r"ATE RMSE \[m\]: (\S+) before, (\S+) after", said)
    assert found is not None
    return float(found[1]), float(found[2])


def test_depth_corrects_the_path(closed: tuple[str, Path]) -> None:
    said, out = closed
    before, after = errors(said)
    assert before > 0.1
    assert after < 0.4 * before
    assert "loops measured in meters, from depth" in said
    assert (out / "paths.png").stat().st_size > 10_000
    assert len(read_poses(out / "closed.txt").poses) == FRAMES


def test_color_corrects_the_path_with_lengths_of_the_odometry(walk: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("rgb", "rgb.txt", "groundtruth.txt", "calibration.txt"):
        (bare / name).symlink_to(walk / name)
    said = close(bare, walk.parent / "loops.csv", tmp_path / "out")
    before, after = errors(said)
    assert after < 0.5 * before
    assert re.search(r"\d\d loops measured in meters, from steps of the odometry", said)
    assert "give a rotation only" in said
    assert "from depth" not in said


def test_one_false_loop_is_tolerated(walk: Path, closed: tuple[str, Path], tmp_path: Path) -> None:
    """The table has a loop of frames 40 and 5, and both have the same picture, so that the images agree."""
    lying = tmp_path / "lying"
    lying.mkdir()
    names = [line.split()[1] for line in (walk / "rgb.txt").read_text().splitlines()[3:]]
    (lying / "rgb").mkdir()
    for number, name in enumerate(names):
        (lying / name).symlink_to(walk / names[5 if number == 40 else number])
    for name in ("depth", "depth.txt", "rgb.txt", "groundtruth.txt", "calibration.txt"):
        (lying / name).symlink_to(walk / name)
    table = tmp_path / "loops.csv"
    table.write_text((walk.parent / "loops.csv").read_text() + "40,5\n")
    _, clean = errors(closed[0])
    _, after = errors(close(lying, table, tmp_path / "out"))
    assert after < 1.2 * clean + 0.005
    with (tmp_path / "out" / "loops.csv").open() as stream:
        used = {(row["query_id"], row["match_id"]): row["used"] for row in csv.DictReader(stream)}
    assert used[("40", "5")] == "no"


def test_the_graph_contains_the_measurements(walk: Path, closed: tuple[str, Path]) -> None:
    _, out = closed
    lines = [line.split() for line in (out / "closed.g2o").read_text().splitlines()]
    vertices = {int(words[1]): np.array(words[2:], float) for words in lines if words[0] == "VERTEX_SE3:QUAT"}
    edges = [
        (int(words[1]), int(words[2]), np.array(words[3:10], float)) for words in lines if words[0] != "VERTEX_SE3:QUAT"
    ]
    assert sorted(vertices) == list(range(FRAMES))
    assert all(len(words) == 31 for words in lines if words[0] == "EDGE_SE3:QUAT")
    odometry = read_poses(out / "odometry.txt").poses
    for i, j, step in edges[: FRAMES - 1]:
        assert j == i + 1
        np.testing.assert_allclose(step, relative_pose(odometry[i], odometry[j]), atol=1e-4)
    sequence = read_sequence(walk).with_poses()
    truth = sequence.poses
    assert truth is not None
    off = [np.linalg.norm(step[:3] - relative_pose(truth[i], truth[j])[:3]) for i, j, step in edges[FRAMES - 1 :]]
    assert np.median(off) < 0.06


def test_odometry_from_a_file(
    walk: Path, closed: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said, out = closed
    line = ["close", str(walk), "--loops", str(walk.parent / "loops.csv"), "--odometry", str(out / "odometry.txt")]
    assert main([*line, "--out", str(tmp_path / "b")]) == 0
    again = capsys.readouterr().out
    assert errors(again) == pytest.approx(errors(said), abs=1e-3)


@pytest.mark.parametrize(
    ("line", "status", "words"),
    [
        ("--drift 2 --loops NONE", 1, "no such file; expected the loops.csv"),
        ("--drift 2 --loops WALK/rgb.txt", 1, "is not a table of loops"),
        ("--drift 2 --loops FAR", 1, 'far.csv:2:1: no frame has the number "900"; there are 90'),
        ("--drift 2 --loops NAMED", 1, 'named.csv:2:1: no selected image of the sequence has the name "x.jpg"'),
        ("--drift 200 --loops LOOPS", 1, "a drift of 200 %; expected"),
        ("--drift 2 --loops LOOPS --camera 1,2,3", 1, "expected FX,FY,CX,CY"),
        ("--drift 2 --loops LOOPS --odometry-form tum", 2, "--odometry-form needs --odometry"),
        ("--odometry FAR --seed 4 --loops LOOPS", 2, "--seed needs --drift"),
        ("--loops LOOPS", 1, "has no odometry; give --odometry FILE, or --drift PERCENT to simulate it"),
    ],
)
def test_errors_are_reported_in_one_line(
    line: str, status: int, words: str, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "far.csv").write_text("query_id,match_id\n900,1\n")
    (tmp_path / "named.csv").write_text("query_id,match_id,query_name,match_name\n9,1,x.jpg,y.jpg\n")
    files = {
        "WALK": walk,
        "LOOPS": walk.parent / "loops.csv",
        "FAR": tmp_path / "far.csv",
        "NAMED": tmp_path / "named.csv",
    }
    for name, path in files.items():
        line = line.replace(name, str(path))
    assert main(["close", str(walk), *line.split(), "--out", str(tmp_path / "out")]) == status
    assert words in capsys.readouterr().err


def test_without_a_camera_its_parameters_are_required(two_laps: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "loops.csv").write_text("query_id,match_id\n25,5\n")
    line = f"close {two_laps} --loops {tmp_path / 'loops.csv'} --drift 1 --out {tmp_path / 'out'}"
    assert main(line.split()) == 1
    assert "has no camera calibration; give --camera FX,FY,CX,CY" in capsys.readouterr().err


def test_every_third_frame(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The table of ``detect WALK,stride=3`` numbers the selected frames, and has their names."""
    sequence = read_sequence(walk).with_poses()
    with (walk.parent / "loops.csv").open() as stream:
        ends = [(int(row["query_id"]) // 3, int(row["match_id"]) // 3) for row in csv.DictReader(stream)]
    table = tmp_path / "thirds.csv"
    names = [sequence.names[3 * i] for i in range(FRAMES // 3)]
    rows = [f"{a},{b},{names[a]},{names[b]}" for a, b in dict.fromkeys(ends)]
    table.write_text("query_id,match_id,query_name,match_name\n" + "\n".join(rows) + "\n")
    line = ["close", f"{walk},stride=3", "--loops", str(table), "--drift", "2", "--out", str(tmp_path / "out")]
    assert main(line) == 0
    said = capsys.readouterr().out
    before, after = errors(said)
    assert after < before
    assert len(read_poses(tmp_path / "out" / "closed.txt").poses) == FRAMES // 3


def test_a_row_that_was_cut_is_refused(tmp_path: Path) -> None:
    table = tmp_path / "l.csv"
    table.write_text("query_id,match_id,score,query_name,match_name\n2,1,0.5,c.png,b.png\n2,1")
    with pytest.raises(InputError, match=r"l\.csv:3:1: has another number of cells"):
        read_loops(table, ImageSequence.of_files([Path(f"{name}.png") for name in "abc"]))


@pytest.mark.parametrize("scale", [5000, 1000])
def test_another_scale_of_the_depth_is_noticed(scale: int, walk: Path) -> None:
    sequence = read_sequence(walk)
    assert sequence.camera is not None
    other = replace(sequence, odometry=sequence.poses, depth_per_m=5000.0 * 5000 / scale)
    said = depth_scale_said(other, sequence.camera)
    assert said == "" if scale == 5000 else "depth-scale=5000" in said


def test_what_is_left_out_has_its_own_reason() -> None:
    path = np.tile([0, 0, 0, 0, 0, 0, 1.0], (30, 1))
    path[:, 0] = np.arange(30)
    path[20:, 0] += 500  # a reset
    path[1:10:2] = np.nan
    one = Relative(np.array([0, 0, 0, 0, 0, 0, 1.0]), METRIC, 200, 1e-4 * np.eye(6), "depth")
    closed = close_path(path, [Loop(8, 0, one), Loop(5, 0, one), Loop(6, 3, one), Loop(6, 0)])
    assert (len(closed.loops), closed.no_path, closed.not_measured, closed.gaps) == (1, 2, 1, 1)
    assert (19, 20) not in {(closed.frames[step.first], closed.frames[step.second]) for step in closed.steps}


def test_a_loop_of_an_image_that_cannot_be_read_is_not_measured(walk: Path, tmp_path: Path) -> None:
    sequence = read_sequence(walk)
    assert sequence.camera is not None
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"")
    loops = read_loops(walk.parent / "loops.csv", sequence)[:8]
    frames = replace(sequence, paths=(broken, *sequence.paths[1:]), depths=None)
    found = measure(frames, [Loop(30, 0), *loops], sequence.camera)
    assert found[0] == Loop(30, 0)
    assert any(loop.relative is not None for loop in found[1:])
