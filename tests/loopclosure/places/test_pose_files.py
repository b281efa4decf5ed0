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
        ("0 1 2 3 0 0 0 1 9\n", "a.txt:1:1: has 9 numbers in a row; expected a file of poses: TUM"),
        ("# empty\n", "a.txt: holds no pose"),
        ("timestamp tx ty tz qx qy qz qw\n", "a.txt: holds no pose"),
        ("1 0 0 0 0 2 0 0 0 0 1 0\n", "a.txt:1:1: its first three columns are not a rotation: M^T M differs"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "a.txt:1:1: its first three columns are a reflection"),
        ("#t,x,y,z,qw,qx,qy,qz\n5,0,0,0,1,1,0,0\n", "a.txt:2:9: qw qx qy qz have length 1.414, a rotation has"),
        ("t,x,y,z,qw,qx,qy,qz\n5,0,0,x,1,0,0,0\n", 'a.txt:2:7: expected a number for tz, found "x"'),
        ("0 1 2 3 0.9 0.9 0 0\n", "a.txt:1:9: qx qy qz qw have length 1.273, a rotation has length 1"),
        ("0 1 2 nan 1 0 0 0\n", 'a.txt:1:7: expected a number for tz, found "nan"'),
        ("0 1 1e300 3 1 0 0 0\n", 'a.txt:1:5: expected a number for ty, found "1e300"'),
        ("#t\n5,0,0,0,1,0,0,0\n", "a.txt:2:9: the last four columns may be qx,qy,qz,qw as in TUM's form or qw,"),
    ],
)
def test_an_invalid_row_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read_poses(write(tmp_path / "a.txt", text))
    assert str(caught.value).startswith(f"{tmp_path}/{message}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fault", ["NaN NaN NaN NaN", "0 0 0 0", "1 1 0 0", "0 0 0", "0 0 zero 1"])
def test_a_row_without_a_usable_pose_is_no_pose(fault: str, tmp_path: Path) -> None:
    rows = tum_rows(path()).splitlines(keepends=True)
    rows[7] = f"7.0 1 2 3 {fault}\n"
    file = write(tmp_path / "poses.txt", "".join(rows))
    read = read_poses(file)
    assert len(read.doubts) == 1
    assert read.doubts[0].startswith("1 of 48 rows has no usable pose; line 8: ")
    others = np.arange(COUNT) != 7
    found = read.of_images(COUNT, np.arange(COUNT) + 0.01, file)
    assert np.isnan(found[7]).all()
    same_poses(found[others], path()[others])
    np.testing.assert_array_equal(read.of_images(COUNT, None, file), found)  # images without a time


def test_a_row_of_a_matrix_without_a_usable_pose_keeps_its_place(tmp_path: Path) -> None:
    rows = kitti_rows(path()).splitlines(keepends=True)
    rows[3] = " ".join(["nan"] * 12) + "\n"
    rows[5] = "1 2 3\n"
    read = read_poses(write(tmp_path / "poses.txt", "".join(rows)), PoseForm("kitti", direction="world-to-camera"))
    assert read.doubts[0] == '2 of 48 rows have no usable pose; line 4: expected a number for column 1, found "nan"'
    assert np.flatnonzero(np.isnan(read.poses[:, 0])).tolist() == [3, 5]
    same_poses(read.poses[6:], np.linalg.inv(path()[6:]))


def listed(order: str, separator: str, factor: int = 1, header: str = "") -> str:
    """The path with quaternions in an order, times in seconds or whole parts of one, and separators."""
    lines = [header + "\n"] if header else []
    for i, (pose, (x, y, z, w)) in enumerate(zip(path(), quaternions(path()), strict=True)):
        turn = (w, x, y, z) if order == "w-first" else (x, y, z, w)
        time = f"{100 + i / 2:.3f}" if factor == 1 else str(100 * factor + i * factor // 2)
        lines.append(separator.join([time, *(f"{value:.6f}" for value in (*pose[:3, 3], *turn))]) + "\n")
    return "".join(lines)


@pytest.mark.parametrize(
    ("text", "order"),
    [
        (listed("w-last", ",", header="timestamp,tx,ty,tz,qx,qy,qz,qw"), "w-last"),
        (
            listed("w-last", ",", 10**9, "#timestamp [ns], p_WS_x, p_WS_y, p_WS_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w"),
            "w-last",
        ),
        (listed("w-first", ",", 10**9, "timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z"), "w-first"),
        (listed("w-first", " ", header="# time x y z qw qx qy qz"), "w-first"),
        (listed("w-last", ";", header="timestamp;tx;ty;tz;q.x;q.y;q.z;q.w"), "w-last"),
        (listed("w-last", ";", header="timestamp;tx;ty;tz;qx;qy;qz;qw").replace(".", ","), "w-last"),
        (listed("w-last", " ").replace(".", ","), "w-last"),
        (listed("w-last", "\t", header="timestamp tx ty tz qx qy qz qw"), "w-last"),
        (listed("w-last", " ", 1000), "w-last"),
        (listed("w-last", " ", 10**9), "w-last"),
    ],
)
def test_the_header_and_the_separators_tell_the_form(text: str, order: str, tmp_path: Path) -> None:
    file = write(tmp_path / "poses.csv", text)
    read = read_poses(file)
    assert read.form.order == order
    same_poses(read.of_images(COUNT, 100 + np.arange(COUNT) / 2, file), path())


def test_the_form_of_a_list_with_commas_and_no_header_must_be_named(tmp_path: Path) -> None:
    file = write(tmp_path / "poses.csv", listed("w-last", ","))
    for word in ("tum", "w-last"):
        same_poses(read_poses(file, pose_form(word)).poses, path())
    file.write_text(listed("w-first", ", ", 10**9))
    for word in ("euroc", "w-first"):
        read = read_poses(file, pose_form(word))
        same_poses(read.poses, path())
        assert read.stamps is not None
        assert read.stamps[:2].tolist() == [100, 100.5]


@pytest.mark.parametrize("factor", [10**3, 10**6, 10**9])
def test_dates_in_another_unit_are_seconds(factor: int, tmp_path: Path) -> None:
    rows = [
        f"{1403636579 * factor + i * factor} {row.split(' ', 1)[1]}\n"
        for i, row in enumerate(tum_rows(path()).splitlines())
    ]
    read = read_poses(write(tmp_path / "a.txt", "".join(rows)))
    assert read.stamps is not None
    np.testing.assert_allclose(read.stamps, 1403636579 + np.arange(COUNT), rtol=0, atol=1e-6)


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
