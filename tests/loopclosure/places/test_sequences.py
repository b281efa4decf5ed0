"""EuRoC, KITTI, VPR benchmarks and videos: the same path from each, and one clear line for what is missing."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.places.datasets import load_sequence, load_traverses
from loopclosure.places.frames import Selection
from loopclosure.places.masks import read_matches
from loopclosure.places.sequences import PoseChoice, benchmark_parts, layout_of, read_sequence, with_odometry
from loopclosure.places.source import extract
from loopclosure.places.truth import Exclusion
from places_layouts import (
    COUNT,
    kitti_rows,
    path,
    quaternions,
    tum_rows,
    write_benchmark,
    write_euroc,
    write_kitti,
    write_tum,
    write_video,
)


def same_path(poses: np.ndarray | None, matrices: np.ndarray) -> None:
    assert poses is not None
    np.testing.assert_allclose(poses[:, :3], matrices[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(np.abs(np.sum(poses[:, 3:] * quaternions(matrices), axis=1)), 1, atol=1e-6)


def test_euroc_has_the_poses_of_the_camera_not_of_the_body(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    assert layout_of(folder) == "euroc"
    sequence = read_sequence(folder)
    same_path(sequence.poses, path())
    assert sequence.names[1] == "mav0/cam0/data/1403636580000000000.png"
    assert sequence.doubts == ()
    assert sequence.camera is not None
    assert sequence.camera.fy == 28.25
    assert sequence.camera.distortion == (-0.28, 0.07, 0.0002, 1.8e-05)
    data = load_sequence(sequence)
    assert {(int(i) - int(j)) for i, j in np.argwhere(data.truth.hard & data.truth.judged)} == {24}


def test_euroc_without_its_truth_or_with_a_missing_image(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    (folder / "mav0/state_groundtruth_estimate0/data.csv").unlink()
    sequence = read_sequence(folder)
    assert sequence.poses is None
    with pytest.raises(InputError, match="MH_00: has no poses; expected"):
        sequence.with_poses()
    (folder / "mav0/cam0/data/1403636581000000000.png").unlink()
    with pytest.raises(InputError, match=r'data\.csv:4:1: no such image "1403636581000000000\.png"'):
        read_sequence(folder)
    with pytest.raises(InputError, match="expected an EuRoC sequence, a folder with mav0/cam0"):
        read_sequence(tmp_path, "euroc")
    for stamp in ("9" * 400, "\u00b2"):
        (folder / "mav0/cam0/data.csv").write_text(f"1,1.png\n{stamp},1.png\n")
        with pytest.raises(InputError, match=r"data\.csv:"):
            read_sequence(folder)


def test_a_list_of_euroc_may_begin_with_the_names_of_its_columns(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    for name in ("mav0/cam0/data.csv", "mav0/state_groundtruth_estimate0/data.csv"):
        (folder / name).write_text((folder / name).read_text().removeprefix("#"))
    sequence = read_sequence(folder)
    assert sequence.pose_fault is None
    same_path(sequence.poses, path())


def test_an_unknown_distortion_is_no_camera(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    sensor = folder / "mav0/cam0/sensor.yaml"
    sensor.write_text(sensor.read_text().replace("radial-tangential", "omni"))
    sequence = read_sequence(folder)
    assert sequence.camera is None
    assert "distortion model omni is not supported" in sequence.doubts[0]
    assert sequence.doubts[0].endswith("; the calibration is not used")
    same_path(sequence.poses, path())


@pytest.mark.parametrize("value", ["99999999999999999999", "1e999", "nan", "0.5"])
def test_without_a_mount_there_are_no_poses(value: str, tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    sensor = folder / "mav0/cam0/sensor.yaml"
    sensor.write_text(sensor.read_text().replace("data: [0,", f"data: [{value},"))
    sequence = read_sequence(folder)
    (remark,) = sequence.remarks()
    assert remark.endswith("; continued without poses")
    with pytest.raises(InputError, match=r"sensor\.yaml: the camera's pose in the body, T_BS: .* not a rotation"):
        sequence.with_poses()


@pytest.mark.parametrize("row", ["30 0 15.5 0 30 0 15.5 0 0 0 1 0", "30 0 15.5 0 0 30 11.5 0 0 0 1 inf"])
def test_without_a_projection_there_is_no_camera_and_no_pose(row: str, tmp_path: Path) -> None:
    folder = write_kitti(tmp_path)
    (folder / "calib.txt").write_text(f"P0: {row}\n")
    sequence = read_sequence(folder)
    assert sequence.camera is None
    assert len(list(sequence.remarks())) == 2
    with pytest.raises(InputError, match=r'calib\.txt: expected "P0:" and the twelve numbers of a projection'):
        sequence.with_poses()


@pytest.mark.parametrize("write", [write_euroc, write_kitti, write_tum])
def test_poses_that_cannot_be_read_do_not_stop_what_needs_none(write: Callable[[Path], Path], tmp_path: Path) -> None:
    folder = write(tmp_path)
    names = ("groundtruth.txt", "mav0/state_groundtruth_estimate0/data.csv", "../../poses/07.txt")
    (file,) = (folder / name for name in names if (folder / name).exists())
    rows = file.read_text()
    file.write_text(rows.replace(rows.splitlines()[5], "1 2 nan", 1))
    sequence = read_sequence(folder)
    assert np.flatnonzero(~sequence.known).tolist() in ([4], [5])  # EuRoC has a line of names
    assert "rows without a usable pose: 1 of 48; line 6: " in sequence.doubts[0]
    same_path(sequence.with_poses().poses, path()[sequence.known])
    for text in ("", "# nothing\n", "a,b\n", "1 2 3\n"):
        file.write_text(text)
        sequence = read_sequence(folder)
        assert len(sequence) == len(list(sequence.frames())) == COUNT
        assert [remark.endswith("; continued without poses") for remark in sequence.remarks()] == [True]
        with pytest.raises(InputError, match=file.name):
            sequence.with_poses()


@pytest.mark.parametrize(("camera", "aside"), [("image_0", 0.0), ("image_2", -0.06)])
def test_kitti_has_the_poses_of_its_camera(camera: str, aside: float, tmp_path: Path) -> None:
    folder = write_kitti(tmp_path, camera)
    assert layout_of(folder) == "kitti"
    sequence = read_sequence(folder)
    beside = np.eye(4)
    beside[0, 3] = aside
    same_path(sequence.poses, path() @ beside)
    assert sequence.stamps is not None
    assert sequence.stamps[3] == 3.0
    assert sequence.camera is not None
    assert (sequence.camera.fx, sequence.camera.cx) == (30, 15.5)


def test_kitti_with_too_few_poses_or_no_images(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path)
    (tmp_path / "dataset/poses/07.txt").write_text(kitti_rows(path()[:40]))
    with pytest.raises(InputError, match=r"07\.txt: has 40 poses, but there are 48 images"):
        read_sequence(folder).with_poses()
    (folder / "times.txt").write_text("0\n1\n")
    with pytest.raises(InputError, match=r"times\.txt: has 2 times, but there are 48 images"):
        read_sequence(folder)
    with pytest.raises(InputError, match="has none of image_0, image_2, image_1, image_3; expected a folder such as"):
        read_sequence(tmp_path, "kitti")


def test_a_file_of_poses_replaces_the_sequences_poses(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path)
    poses = tmp_path / "slam.txt"
    poses.write_text(tum_rows(path()[:30]))
    sequence = read_sequence(folder, poses=PoseChoice(poses))
    assert (len(sequence), len(sequence.with_poses())) == (48, 30)
    assert sequence.with_poses().names[29] == "image_0/000029.png"


@pytest.mark.parametrize(
    ("write", "name"), [(write_euroc, "mav0/state_groundtruth_estimate0/data.csv"), (write_kitti, "../../poses/07.txt")]
)
def test_poses_are_the_cameras_wherever_they_lie(write: Callable[[Path], Path], name: str, tmp_path: Path) -> None:
    folder = write(tmp_path)
    sequence = read_sequence(folder)
    moved_away = PoseChoice((folder / name).resolve().rename(tmp_path / "poses"))
    for found in (read_sequence(folder, poses=moved_away).poses, with_odometry(sequence, moved_away).odometry):
        assert found is not None
        np.testing.assert_array_equal(found, sequence.poses)


def test_a_video_is_extracted_once(tmp_path: Path) -> None:
    video = write_video(tmp_path / "drive.avi")
    extracted = extract(video, tmp_path / "frames")
    folder = extracted.folder
    assert extracted.said == f"{video}: 48 frames: {folder}"
    poses = tmp_path / "poses.txt"
    poses.write_text(tum_rows(path()))
    same_path(read_sequence(folder, poses=PoseChoice(poses)).poses, path())
    again = extract(video, tmp_path / "frames")
    assert (again.folder, again.said) == (folder, f"{video}: its frames are in {folder} already")
    other = write_video(tmp_path / "other.avi")
    with pytest.raises(InputError, match="already exists, and was not made from"):
        extract(other, folder)


def test_a_benchmark_with_its_lists_of_matches(tmp_path: Path) -> None:
    folder = write_benchmark(tmp_path)
    queries, references, truth = benchmark_parts(folder)
    data = load_traverses(queries, references, truth_file=truth)
    assert data.truth.hard.shape == (12, 14)
    assert {(int(i), int(j)) for i, j in np.argwhere(data.truth.hard)} == {
        (i, i + k) for i in range(12) for k in range(3)
    }
    (tmp_path / "lists.json").write_text(str([[i, i + 1, i + 2] for i in range(12)]))
    np.testing.assert_array_equal(read_matches(tmp_path / "lists.json", 12, 14)[0], data.truth.hard)
    np.save(tmp_path / "mask.npy", data.truth.hard)
    np.testing.assert_array_equal(read_matches(tmp_path / "mask.npy", 12, 14)[0], data.truth.hard)


def test_errors_of_a_benchmark_are_reported(tmp_path: Path) -> None:
    folder = write_benchmark(tmp_path / "a", references=12)
    with pytest.raises(InputError, match="names query 10 and reference 12; there are 12 queries and 12 references"):
        load_traverses(folder / "query", folder / "ref", truth_file=folder / "ground_truth.json")
    (folder / "ground_truth.json").unlink()
    with pytest.raises(InputError, match=r"expected one ground_truth\*\.json or \.npy, found none"):
        benchmark_parts(folder)
    with pytest.raises(InputError, match="has no folder query or queries or Query with the queries"):
        benchmark_parts(tmp_path)


def test_a_selection_counts_frames_without_a_pose(two_laps, tmp_path):
    shutil.copytree(two_laps, tmp_path / "laps")
    truth = (tmp_path / "laps" / "groundtruth.txt").read_text().splitlines()
    (tmp_path / "laps" / "groundtruth.txt").write_text("\n".join(line for line in truth if line[:2] != "4.") + "\n")
    every_fourth = read_sequence(tmp_path / "laps").taken(Selection(stride=4))
    assert every_fourth.names[:3] == ("rgb/0.png", "rgb/4.png", "rgb/8.png")
    assert every_fourth.poses is not None
    assert np.isnan(every_fourth.poses[1]).all()
    data = load_sequence(read_sequence(tmp_path / "laps", "tum"), Selection(stride=4), Exclusion(2))
    assert [path.name for path in data.queries.paths[:2]] == ["0.png", "8.png"]
