"""Loops as CSV and g2o: frames of reference, order of quaternions, and no made-up poses."""

import csv
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopclosure.closing.measure import read_loops
from loopclosure.detector.detector import LoopResult
from loopclosure.detector.export import Sigmas, relative_pose, write_g2o, write_loops_csv
from loopclosure.errors import InputError
from loopclosure.places.frames import Selection
from loopclosure.places.image_sequence import ImageSequence


def matrix(pose):
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_quat(pose[3:]).as_matrix()
    transform[:3, 3] = pose[:3]
    return transform


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    return np.concatenate([rng.normal(size=(4, 3)), Rotation.random(4, rng).as_quat()], axis=1)


def loop(query, match, inliers=None):
    return LoopResult(query, [(match, -0.25)], match, "accepted", -0.25, inliers, None)


def test_g2o_edges_chain_the_vertices(tmp_path, poses):
    path = tmp_path / "out" / "graph.g2o"
    left_out = write_g2o(
        path,
        poses,
        [loop(3, 0), loop(3, 1)],
        lambda q, m: (relative_pose(poses[m], poses[q]), np.eye(6)) if m == 0 else None,
    )
    assert left_out == 1
    vertices, edges = {}, []
    for line in path.read_text().splitlines():
        tag, *fields = line.split()
        if tag == "VERTEX_SE3:QUAT":
            vertices[int(fields[0])] = np.array(fields[1:], float)
        else:
            assert tag == "EDGE_SE3:QUAT"
            assert len(fields) == 2 + 7 + 21
            edges.append((int(fields[0]), int(fields[1]), np.array(fields[2:9], float)))
    assert [(a, b) for a, b, _ in edges] == [(0, 1), (1, 2), (2, 3), (0, 3)]
    for a, b, step in edges:
        np.testing.assert_allclose(matrix(vertices[a]) @ matrix(step), matrix(vertices[b]), atol=1e-6)


def test_information_is_the_inverse_of_squared_sigmas():
    values = [float(v) for v in Sigmas(0.1, 0.5).information()[np.triu_indices(6)]]
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = values
    np.testing.assert_allclose(full, np.diag([100, 100, 100, 4, 4, 4]))


def test_frames_without_a_pose_have_no_vertex(tmp_path, poses):
    poses[1] = np.nan
    left_out = write_g2o(
        tmp_path / "g.g2o", poses, [loop(3, 1)], lambda q, m: (np.array([0, 0, 0, 0, 0, 0, 1.0]), np.eye(6))
    )
    lines = (tmp_path / "g.g2o").read_text().splitlines()
    assert left_out == 1
    assert [line.split()[1] for line in lines if line.startswith("VERTEX")] == ["0", "2", "3"]
    assert [line.split()[1:3] for line in lines if line.startswith("EDGE")] == [["0", "2"], ["2", "3"]]
    with pytest.raises(InputError, match="no frame has a pose"):
        write_g2o(tmp_path / "g.g2o", np.full((3, 7), np.nan), [], lambda q, m: None)


def test_csv(tmp_path):
    stamps = np.array([0.0, np.nan, 2.5])
    write_loops_csv(tmp_path / "loops.csv", [loop(2, 0, 31), loop(2, 1)], stamps, ["a.png", "b.png", "c.png"])
    with (tmp_path / "loops.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert rows[0] == {
        "query_id": "2",
        "match_id": "0",
        "score": "-0.25",
        "inliers": "31",
        "query_stamp": "2.500000",
        "match_stamp": "0.000000",
        "query_name": "c.png",
        "match_name": "a.png",
        "score_of": "image",
    }
    assert (rows[1]["inliers"], rows[1]["match_stamp"], rows[1]["match_name"]) == ("", "", "b.png")


def named(*names: str) -> ImageSequence:
    return ImageSequence.of_files([Path(name) for name in names])


def test_frames_of_a_video_are_found_by_their_numbers(tmp_path: Path) -> None:
    """``detect`` reads the video itself; ``close`` reads the images that it wrote, of the same selected frames."""
    video = ImageSequence.of_video(tmp_path / "d.avi", 40).taken(Selection(start=4, stride=3))
    found = [LoopResult(7, [(2, 0.5)], 2, "accepted", 0.5), LoopResult(11, [(0, 0.5)], 0, "accepted", 0.5)]
    write_loops_csv(tmp_path / "loops.csv", found, None, video.names)
    assert "frame 25,frame 10" in (tmp_path / "loops.csv").read_text()
    images = named(*(f"rgb/{i:06d}.png" for i in range(40)))
    for frames in (video, images.taken(Selection(start=4, stride=3))):
        assert [(loop.query, loop.match) for loop in read_loops(tmp_path / "loops.csv", frames)] == [(7, 2), (11, 0)]
    whole = [(loop.query, loop.match) for loop in read_loops(tmp_path / "loops.csv", images)]
    assert whole == [(25, 10), (37, 4)]
    with pytest.raises(InputError, match='no selected image of the sequence has the name "frame 25"'):
        read_loops(tmp_path / "loops.csv", images.taken(Selection(stride=2)))


def test_a_name_can_be_any_bytes(tmp_path):
    """A name that a spreadsheet would evaluate is written as text, and read back."""
    names = [os.fsdecode(name) for name in (b"=1+1.png", b"caf\xe9.png")]
    write_loops_csv(tmp_path / "loops.csv", [loop(1, 0)], names=names)
    assert b"caf\xe9.png,'=1+1.png" in (tmp_path / "loops.csv").read_bytes()
    (found,) = read_loops(tmp_path / "loops.csv", named(*names))
    assert (found.query, found.match) == (1, 0)


def test_control_characters_of_names_are_escaped_and_restored(tmp_path: Path) -> None:
    names = ["a\x1b[2J\x9b.png", "b.png"]
    write_loops_csv(tmp_path / "loops.csv", [LoopResult(1, [(0, 0.5)], 0, "accepted", 0.5)], None, names)
    assert not set(b"\x1b\x9b") & set((tmp_path / "loops.csv").read_bytes())
    (loop,) = read_loops(tmp_path / "loops.csv", named(*names))
    assert (loop.query, loop.match) == (1, 0)
