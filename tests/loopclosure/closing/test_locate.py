"""Where a camera was in a map: the frames between those of a rendered walk, by its true poses."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lmdb_build.cli import main as lmdb_build
from loopclosure.cli import main
from loopclosure.closing.locate import Locator
from loopclosure.closing.relative import METRIC
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.detector.map import Map
from loopclosure.places.frames import read_bgr
from loopclosure.places.sequences import read_sequence

OTHERS = "walk_1,start=1,stop=24,stride=2"


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered walk with depth, and a map of every second frame."""
    folder = tmp_path_factory.mktemp("walks")
    assert lmdb_build(["walk", str(folder), "--frames", "60", "--size", "160x120", "--depth", "--laps", "1"]) == 0
    build(folder / "map", folder)
    return folder


def build(into: Path, walks: Path) -> Map:
    known = Map.create(into, "small")
    known.add(read_sequence(str(walks / "walk_1")).at(range(0, 24, 2)), Thumbnailer())
    return known


@pytest.fixture(autouse=True)
def thumbnails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopclosure.detector.describers._entry_point", lambda name: Thumbnailer)


def query(known: Path, walks: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> tuple[list[dict[str, str]], str]:
    """Ask where the other frames are; return the rows of loops.csv and what was printed."""
    assert main(["map", "query", str(known), f"{walks / OTHERS}", "--out", str(out)]) == 0
    with (out / "loops.csv").open() as stream:
        return list(csv.DictReader(stream)), capsys.readouterr().out


def errors(rows: list[dict[str, str]], walks: Path) -> np.ndarray:
    """The errors (N, 2) of position in meters and of rotation in degrees; NaN without a position."""
    true = read_sequence(str(walks / "walk_1")).poses
    assert true is not None
    found = []
    for row in rows:
        pose = [float(row[f"map_{name}"] or "nan") for name in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
        expected = true[1 + 2 * int(row["query_id"])]
        turn = Rotation.from_quat(expected[3:]).inv() * Rotation.from_quat(pose[3:])
        found.append((np.linalg.norm(expected[:3] - pose[:3]), np.rad2deg(turn.magnitude())))
    return np.array(found)


def test_a_query_says_where_the_camera_was(walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows, said = query(walks / "map", walks, tmp_path, capsys)
    assert len(rows) >= 6
    located = [row for row in rows if row["map_by"]]
    assert {row["map_by"] for row in located} == {"poses"}
    assert {row["relative"] for row in located} == {METRIC}
    assert len(located) >= 6
    position, rotation = np.median(errors(located, walks), axis=0)
    assert position < 0.04
    assert rotation < 1
    assert f"position {position:.2g} m (of {len(located)}), rotation {rotation:.2g} degrees" in said
    assert f"located in the frame of the map's poses: {len(located)} with position and rotation, 0 with" in said


@pytest.mark.slow
def test_odometry_is_named_and_not_judged(walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(walks / "walk_1", tmp_path / "walk_1")
    (tmp_path / "walk_1" / "groundtruth.txt").rename(tmp_path / "walk_1" / "odometry.txt")
    build(tmp_path / "map", tmp_path)
    rows, said = query(tmp_path / "map", walks, tmp_path / "out", capsys)
    located = [row for row in rows if row["map_by"]]
    assert {row["map_by"] for row in located} == {"odometry"}
    assert np.median(errors(located, walks)[:, 0]) < 0.04
    assert "by the map's odometry, which drifts" in said
    assert "median errors" not in said


@pytest.mark.slow
def test_without_depth_there_is_a_rotation(walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(walks / "walk_1", tmp_path / "walk_1")
    (tmp_path / "walk_1" / "depth.txt").unlink()
    build(tmp_path / "map", tmp_path)
    assert Map(tmp_path / "map").sessions[0].depths is None
    rows, said = query(tmp_path / "map", tmp_path, tmp_path / "out", capsys)
    located = [row for row in rows if row["map_by"]]
    assert {row["map_x_m"] for row in located} == {""}
    position, rotation = errors(located, walks).T
    assert np.isnan(position).all()
    assert np.median(rotation) < 1
    assert f"0 with position and rotation, {len(located)} with rotation only" in said


def test_a_map_without_a_camera(walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line says what is missing."""
    shutil.copytree(walks / "map", tmp_path / "map")
    (tmp_path / "map" / "000000" / "calibration.txt").unlink()
    rows, said = query(tmp_path / "map", walks, tmp_path / "out", capsys)
    assert {row["relative"] + row["map_by"] + row["map_qw"] for row in rows} == {""}
    assert f"not located: {len(rows)}, matched in 000000, where the map has no calibration of the camera" in said


def test_a_source_without_a_camera(walks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(walks / "walk_1", tmp_path / "walk_1")
    (tmp_path / "walk_1" / "calibration.txt").unlink()
    rows, said = query(walks / "map", tmp_path, tmp_path / "out", capsys)
    assert {row["map_by"] for row in rows} == {""}
    assert "not located: the source of the query has no calibration of its camera" in said


def test_one_image(walks: Path) -> None:
    known = Map(walks / "map")
    sequence = read_sequence(str(walks / "walk_1"))
    assert sequence.camera is not None
    assert sequence.poses is not None
    located = Locator(known, sequence.camera).locate(read_bgr(sequence.paths[1]), 0)
    assert located is not None
    assert located.pose is not None
    assert located.by == "poses"
    assert np.linalg.norm(located.pose[:3] - sequence.poses[1][:3]) < 0.05
    blank = np.zeros((120, 160, 3), np.uint8)
    assert Locator(known, sequence.camera).locate(blank, 0) is None
