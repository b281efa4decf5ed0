"""``loopclosure map close``: two drives of a rendered robot, each in the frame of its wheels, and a third elsewhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphs import read_graph
from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.cli import main
from loopclosure.closing.close import ate_rmse_m, drifted
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.detector.export import after
from loopclosure.detector.map import Map
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.pose_files import read_poses
from loopclosure.places.sequences import read_sequence

pytestmark = pytest.mark.slow
FRAMES = 64
ELSEWHERE = np.array([50, -20, 3, *Rotation.from_euler("zyx", [170, 20, 5], degrees=True).as_quat()])


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ImageSequence]:
    """A map of two laps of one house, each a session, and of a few images of another."""
    folder = tmp_path_factory.mktemp("sessions")
    sequences = []
    for seed, frames in ((1, FRAMES), (9, 4)):
        for _ in write_walk(folder / f"walk_{seed}", Walk(frames, 160, 120, laps=2, seed=seed)):
            pass
        sequences.append(read_sequence(folder / f"walk_{seed}"))
    walk, other = sequences
    made = Map.create(folder / "map", "small")
    for number, frames in enumerate((range(FRAMES // 2), range(FRAMES // 2, FRAMES))):
        drive = walk.at(frames)
        assert drive.poses is not None
        path = drifted(drive.poses, 2.0, 1 + number)
        made.add(replace(drive, odometry=after(ELSEWHERE, path) if number else path), Thumbnailer())
    made.add(other, Thumbnailer())
    return folder / "map", walk


def test_the_sessions_of_a_map_are_in_one_frame(
    known: tuple[Path, ImageSequence], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, walk = known
    assert main(["map", "close", str(folder), "--out", str(tmp_path / "closed")]) == 0
    said = capsys.readouterr().out
    assert "2 of 3 sessions are in one frame, that of 000000" in said
    assert "no loop joins them, so each is in its own frame: 000002" in said
    paths = [read_poses(tmp_path / "closed" / f"00000{number}.txt") for number in range(3)]
    assert [len(path.poses) for path in paths] == [FRAMES // 2, FRAMES // 2, 4]
    assert walk.poses is not None
    assert walk.stamps is not None
    np.testing.assert_allclose(np.concatenate([p.stamps for p in paths[:2] if p.stamps is not None]), walk.stamps)
    whole = np.concatenate([path.poses for path in paths[:2]])
    error, drift = ate_rmse_m(whole, walk.poses), ate_rmse_m(drifted(walk.poses, 2.0, 1), walk.poses)
    print(f"ATE of both sessions in one frame {error:.3f} m; one drive of both drifts by {drift:.3f} m")
    assert error < 0.25
    assert error < 0.6 * drift
    vertices, edges = read_graph(tmp_path / "closed" / "closed.g2o")
    assert len(vertices) == FRAMES + 4
    assert not any((edge.first, edge.second) == (FRAMES // 2 - 1, FRAMES // 2) for edge in edges)


def test_a_camera_on_the_command_line(
    known: tuple[Path, ImageSequence], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.setattr("loopclosure.detector.describers._entry_point", lambda name: Thumbnailer)
    images = str(known[1].source / "rgb")
    line = ["map", "build", str(tmp_path / "bare"), f"{images},stop=3"]
    assert main(line) == 0
    capsys.readouterr()
    assert main(["map", "close", str(tmp_path / "bare"), "--out", str(tmp_path / "out")]) == 1
    assert "has no calibration of a camera; build it again, with --camera" in capsys.readouterr().err
    line[2] = str(tmp_path / "known")
    assert main([*line, "--camera", "131.25,131.25,79.5,59.5"]) == 0
    camera = Map(tmp_path / "known").sessions[0].camera
    assert camera is not None
    assert (camera.fx, camera.cy) == (131.25, 59.5)
    assert main([*line[:2], str(tmp_path / "other"), *line[3:], "--camera", "1,2,3"]) == 1
    assert "expected FX,FY,CX,CY" in capsys.readouterr().err
