"""Poses in the formats of TUM, KITTI and EuRoC give the same path, and a message if they look wrong."""

from pathlib import Path

import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.places.pose_files import PoseForm, inverse, moved, pose_form, read_poses
from loopclosure.places.sequences import read_sequence
from paths import shared
from places_layouts import COUNT, MOUNT, euroc_rows, kitti_rows, path, quaternions, tum_rows


def write(file: Path, text: str) -> Path:
    file.write_text(text)
    return file


def same_poses(found: np.ndarray, matrices: np.ndarray) -> None:
    np.testing.assert_allclose(found[:, :3], matrices[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(np.abs(np.sum(found[:, 3:] * quaternions(matrices), axis=1)), 1, atol=1e-6)


@pytest.mark.parametrize("rows", [tum_rows, kitti_rows, euroc_rows])
def test_one_path_in_each_form(rows, tmp_path: Path) -> None:
    read = read_poses(write(tmp_path / "poses.txt", rows(path())))
    same_poses(read.poses, path())
    assert read.doubts == ()
    assert read.form.form == rows.__name__.removesuffix("_rows")
    if rows is kitti_rows:
        assert read.stamps is None
    else:
        assert read.stamps is not None
        np.testing.assert_allclose(np.diff(read.stamps), 1)


def test_direction_and_order_of_poses_can_be_set(tmp_path: Path) -> None:
    inverted = np.linalg.inv(path())
    read = read_poses(write(tmp_path / "a.txt", kitti_rows(inverted)), PoseForm(direction="world-to-camera"))
    same_poses(read.poses, path())
    rows = [row.split() for row in tum_rows(path()).splitlines()]
    turned = "".join(" ".join([*row[:4], row[7], *row[4:7]]) + "\n" for row in rows)
    read = read_poses(write(tmp_path / "b.txt", turned), pose_form("w-first"))
    same_poses(read.poses, path())


def test_the_wrong_order_and_the_wrong_direction_are_noticed(tmp_path: Path) -> None:
    rows = [row.split() for row in tum_rows(path()).splitlines()]
    turned = "".join(" ".join([*row[:4], row[7], *row[4:7]]) + "\n" for row in rows)
    (doubt,) = read_poses(write(tmp_path / "a.txt", turned)).doubts
    assert doubt.endswith("say so with pose-form=w-first")
    (doubt,) = read_poses(write(tmp_path / "b.txt", kitti_rows(np.linalg.inv(path())))).doubts
    assert doubt.endswith("say so with pose-form=world-to-camera")


def test_a_jump_is_noticed(tmp_path: Path) -> None:
    poses = path()
    poses[30:, 0, 3] += 300
    (doubt,) = read_poses(write(tmp_path / "a.txt", kitti_rows(poses))).doubts
    assert doubt.startswith("the path jumps 1 time: by 297 m from pose 30 to 31, where")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0 1 0 0 0 1 0 0\n", "a.txt:1:1: has 11 numbers in a row; expected a file of poses: TUM"),
        ("# empty\n", "a.txt: holds no pose"),
        ("1 0 0 0 0 2 0 0 0 0 1 0\n", "a.txt:1:1: its first three columns are not a rotation: M^T M differs"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "a.txt:1:1: its first three columns are a reflection"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0\n", "a.txt:2:1: has 8 numbers, a row of KITTI's form has 12"),
        ("#t\n5,0,0,0,1,1,0,0\n", "a.txt:2:9: qw qx qy qz have length 1.414, a rotation has length 1"),
        ("5,0,0,x,1,0,0,0\n", 'a.txt:1:7: expected a number for column 4, found "x"'),
        ("0 1 2 3 0.9 0.9 0 0\n", "a.txt:1:9: qx qy qz qw have length 1.273, a rotation has length 1"),
    ],
)
def test_an_invalid_row_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read_poses(write(tmp_path / "a.txt", text))
    assert str(caught.value).startswith(f"{tmp_path}/{message}")
    assert "\n" not in str(caught.value)


def test_an_unknown_word_of_the_form_names_the_known_ones() -> None:
    with pytest.raises(InputError, match='"xyzw" is not a form of poses; known: tum, kitti, euroc, w-'):
        pose_form("tum,xyzw")


def test_inverse_and_mount_are_those_of_matrices(tmp_path: Path) -> None:
    poses = read_poses(write(tmp_path / "poses.txt", kitti_rows(path()))).poses
    same_poses(inverse(poses), np.linalg.inv(path()))
    same_poses(moved(poses, MOUNT), path() @ MOUNT)


def test_poses_without_a_time_are_those_of_the_images_in_order(tmp_path: Path) -> None:
    file = write(tmp_path / "poses.txt", kitti_rows(path()))
    read = read_poses(file)
    assert read.of_images(COUNT, np.arange(COUNT) + 100.0, file) is read.poses
    with pytest.raises(InputError, match="has 48 poses, but there are 40 images; the poses have no time, so pose i"):
        read.of_images(40, None, file)


@pytest.mark.parametrize("name", ["xyz", "rpy"])
def test_real_paths_of_tum_give_no_warning(name: str) -> None:
    assert read_sequence(shared("data", "tum_fr1", f"rgbd_dataset_freiburg1_{name}"), "tum").doubts == ()
