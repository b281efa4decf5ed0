"""TUM RGB-D files: their contents, and errors for broken lines."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.pose_files import read_poses
from loopclosure.places.sequences import read_sequence
from loopclosure.places.trajectory import (
    associate,
    at,
    pieces,
    write_rgb_list,
    write_trajectory,
)
from netspec.errors import SpecError
from paths import shared


def write_poses(path: Path, *stamps: float) -> None:
    write_trajectory(path, np.array(stamps), np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(stamps), 1)))


def pictures(folder: Path, *names: str) -> None:
    (folder / "rgb").mkdir()
    for name in names:
        (folder / "rgb" / name).touch()


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_an_invalid_line_of_rgb_txt_is_reported(tmp_path: Path) -> None:
    pictures(tmp_path, "a.png", "b.png")
    path = write(tmp_path / "rgb.txt", "1.0 rgb/a.png\n2.0 rgb/gone.png\n")
    with pytest.raises(SpecError, match=r"rgb\.txt:2:5: no such image \"rgb/gone.png\""):
        read_sequence(tmp_path, "tum")
    write(path, "1.0 rgb/a.png\nrgb/b.png\n")
    with pytest.raises(SpecError, match=r"rgb\.txt: has lines without a time stamp; expected \"timestamp filename\""):
        read_sequence(tmp_path, "tum")


def test_missing_depth_images_are_a_warning(tmp_path: Path) -> None:
    pictures(tmp_path, "a.png")
    write(tmp_path / "rgb.txt", "1.0 rgb/a.png\n")
    write(tmp_path / "depth.txt", "1.0 depth/a.png\n")
    write_poses(tmp_path / "groundtruth.txt", 1.0, 2.0)
    sequence = read_sequence(tmp_path)
    assert sequence.depths is None
    assert sequence.doubts[-1].endswith(f'no such image "depth/a.png" in {tmp_path}; depth is not used')


def test_depth_images_are_found_by_their_times_in_any_order(tmp_path: Path) -> None:
    pictures(tmp_path, "a.png", "b.png", "c.png")
    write(tmp_path / "rgb.txt", "1.0 rgb/a.png\n2.0 rgb/b.png\n3.0 rgb/c.png\n")
    (tmp_path / "depth").mkdir()
    for name in ("a.png", "c.png"):
        (tmp_path / "depth" / name).touch()
    write(tmp_path / "depth.txt", "3.01 depth/c.png\n0.98 depth/a.png\n")
    assert read_sequence(tmp_path).depths == (tmp_path / "depth/a.png", None, tmp_path / "depth/c.png")


def test_missing_empty_and_binary_files_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_sequence(tmp_path / "nowhere", "tum").with_poses()
    with pytest.raises(InputError, match=r"rgb\.txt: no such file; expected a TUM RGB-D sequence"):
        read_sequence(tmp_path, "tum").with_poses()
    write(tmp_path / "rgb.txt", "# nothing\n")
    with pytest.raises(SpecError, match=r"rgb\.txt: lists no images"):
        read_sequence(tmp_path, "tum").with_poses()
    pictures(tmp_path, "a.png")
    write(tmp_path / "rgb.txt", "1.5 rgb/a.png\n")
    (tmp_path / "groundtruth.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"groundtruth\.txt: is not a text file"):
        read_sequence(tmp_path, "tum").with_poses()
    write(tmp_path / "groundtruth.txt", "")
    with pytest.raises(InputError, match=r"groundtruth\.txt: holds no pose"):
        read_sequence(tmp_path, "tum").with_poses()


def test_associate_chooses_the_nearest_pose_within_the_limit() -> None:
    stamps = np.array([1.0, 2.0, 3.0])
    frames = np.array([0.5, 0.98, 1.02, 1.51, 2.49, 3.0, 3.03, 3.2])
    assert associate(frames, stamps, 0.05).tolist() == [-1, 0, 0, -1, -1, 2, 2, -1]
    assert associate(frames, stamps, 1.0).tolist() == [0, 0, 0, 1, 1, 2, 2, 2]


def path_at(*x: float) -> np.ndarray:
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(x), 1))
    poses[:, 0] = x
    return poses


def test_between_two_poses_the_speed_is_constant() -> None:
    poses = path_at(0, 1)
    poses[:, 3:] = Rotation.from_rotvec(np.radians([[0, 0, 170], [0, 0, -170]])).as_quat()
    found = at(np.array([10.0, 10.4]), poses, np.array([9.9, 10.0, 10.1, 10.2, 10.4, 10.5]))
    np.testing.assert_allclose(found[:, 0], [np.nan, 0, 0.25, 0.5, 1, np.nan])
    turns = Rotation.from_quat(found[1:5, 3:]).as_euler("xyz", degrees=True)[:, 2]
    np.testing.assert_allclose(turns % 360, [170, 175, 180, 190])


def test_no_pose_lies_in_a_gap_or_a_jump() -> None:
    stamps = np.array([0, 0.1, 0.2, 2, 2.1, 2.2, 2.3])
    found = at(stamps, path_at(0, 0.1, 0.2, 2, 2.1, 40, 40.1), np.array([0.15, 1.0, 2.05, 2.15, 2.25]))
    np.testing.assert_allclose(found[:, 0], [0.15, np.nan, 2.05, np.nan, 40.05])


@pytest.mark.parametrize(
    ("x", "stamps", "expected"),
    [
        pytest.param([49.5, 49.75, 50, 0, 0.25], [0, 0.1, 0.2, 0.3, 0.4], [3], id="reset"),
        pytest.param([0, 0, 0, 0, 1, 2, 3, 3, 3], None, [], id="stands and goes"),
        pytest.param([0, 0.1, 0.2, 0.3, 0.4], [0, 0.1, 0.2, -50, -49.9], [3], id="time goes back"),
        pytest.param([0, 1, 2, 30, 31], [0, 1, 2, 30, 31], [], id="a pause of the camera"),
        pytest.param([0, 1, np.nan, np.nan, 4, 5, 60], None, [6], id="without odometry"),
        pytest.param([0, 1e-4, 0, 1e-4, 0, 0.4, 0.8], None, [], id="noise"),
    ],
)
def test_a_jump_separates_two_pieces(x: list[float], stamps: list[float] | None, expected: list[int]) -> None:
    found = pieces(path_at(*x), None if stamps is None else np.array(stamps))
    assert np.flatnonzero(np.diff(found, prepend=0)).tolist() == expected
    assert pieces(path_at(*x), starts=[0, 2])[2] == pieces(path_at(*x), starts=[0, 2])[1] + 1


def test_frames_without_a_pose_are_counted_and_omitted(tmp_path: Path) -> None:
    frames = [(stamp, f"rgb/{stamp:g}.png") for stamp in (1.0, 1.01, 5.0, 2.0)]
    pictures(tmp_path, *(Path(name).name for _, name in frames))
    write_rgb_list(tmp_path / "rgb.txt", frames)
    write_poses(tmp_path / "groundtruth.txt", 1.0, 2.0)
    every = read_sequence(tmp_path, "tum")
    sequence = every.with_poses()
    assert sequence.name == tmp_path.name
    assert list(sequence.names) == ["rgb/1.png", "rgb/1.01.png", "rgb/2.png"]
    assert sequence.stamps is not None
    assert sequence.stamps.tolist() == [1.0, 1.01, 2.0]
    assert len(every) == 4
    assert len(sequence.known_poses()[np.array([0, 2])]) == 2


def test_an_error_without_poses_has_both_time_spans(tmp_path: Path) -> None:
    pictures(tmp_path, "a.png")
    write_rgb_list(tmp_path / "rgb.txt", [(100.0, "rgb/a.png")])
    write_poses(tmp_path / "groundtruth.txt", 1.0, 2.0)
    with pytest.raises(InputError, match=r"images from 100\.000 to 100\.000 s, poses from 1\.000 to 2\.000 s"):
        read_sequence(tmp_path, "tum").with_poses()


def test_written_lists_can_be_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(20, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    stamps, poses = 1e9 + np.arange(20) / 97, np.hstack([rng.normal(size=(20, 3)), quaternions])
    folder = tmp_path / "caf\udce9"  # a name that is not UTF-8
    folder.mkdir()
    write_trajectory(folder / "groundtruth.txt", stamps, poses)
    back = read_poses(folder / "groundtruth.txt")
    assert back.stamps is not None
    np.testing.assert_allclose(back.stamps, stamps, atol=1e-6)
    np.testing.assert_allclose(back.poses, poses, atol=2e-6)


@pytest.mark.parametrize(("name", "posed", "listed"), [("xyz", 796, 798), ("rpy", 721, 723)])
def test_tum_fr1_has_the_poses_its_readme_counts(name: str, posed: int, listed: int) -> None:
    folder = shared("data", "tum_fr1", f"rgbd_dataset_freiburg1_{name}")
    sequence = read_sequence(folder, "tum", 0.03)
    poses = sequence.with_poses().known_poses()
    assert (len(poses), len(sequence)) == (posed, listed)
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:], axis=1), 1, atol=1e-12)
