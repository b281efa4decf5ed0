"""Poses in the formats of TUM, KITTI and EuRoC give the same path, and a message if they look wrong."""

from pathlib import Path

import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.places.pose_files import PoseForm, pose_form, read_poses
from loopclosure.places.trajectory import inverse, moved
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
    assert read.form == rows.__name__.removesuffix("_rows")
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


@pytest.mark.parametrize(
    ("text", "line"),
    [
        pytest.param("1 0 0 0 1 0 0 0 1 0 0\n", 1, id="eleven columns"),
        pytest.param("0 1 2 3 0 0 0 1 9\n", 1, id="nine columns"),
        pytest.param("5 1 0 0 0 0 1 0 0 0 0 1 0\n", 1, id="time and matrix"),
        pytest.param("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n", 1, id="four by four"),
        pytest.param("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, NAME\n1 1 0 0 0 0 0 0 a.png\n", 2, id="colmap"),
        pytest.param("# empty\n", 0, id="empty"),
        pytest.param("timestamp tx ty tz qx qy qz qw\n", 0, id="names only"),
        pytest.param("timestamp,lat,lon\n1,2,3\n", 1, id="other names"),
        pytest.param("secs,nsecs,x,y,z,qx,qy,qz,qw\n1,2,0,0,0,0,0,0,1\n", 1, id="two columns of time"),
        pytest.param("1 0 0 0 0 2 0 0 0 0 1 0\n", 1, id="no rotation"),
        pytest.param("1 0 0 0 0 1 0 0 0 0 -1 0\n", 1, id="reflection"),
        pytest.param("#t,x,y,z,qw,qx,qy,qz\n5,0,0,0,1,1,0,0\n", 2, id="length of a quaternion"),
        pytest.param("t,x,y,z,qw,qx,qy,qz\n5,0,0,x,1,0,0,0\n", 2, id="no number"),
        pytest.param("0 1 2 nan 1 0 0 0\n", 1, id="nan"),
        pytest.param("0 1 1e300 3 1 0 0 0\n", 1, id="too large"),
    ],
)
def test_an_invalid_table_is_one_line(text: str, line: int, tmp_path: Path) -> None:
    file = write(tmp_path / "a.txt", text)
    with pytest.raises(InputError) as caught:
        read_poses(file)
    assert caught.value.where is not None
    assert (caught.value.where.file, caught.value.where.line) == (str(file), line)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fault", ["NaN NaN NaN NaN", "0 0 0 0", "1 1 0 0", "0 0 0", "0 0 zero 1"])
def test_a_row_without_a_usable_pose_is_no_pose(fault: str, tmp_path: Path) -> None:
    rows = tum_rows(path()).splitlines(keepends=True)
    rows[7] = f"7.0 1 2 3 {fault}\n"
    file = write(tmp_path / "poses.txt", "".join(rows))
    read = read_poses(file)
    assert len(read.doubts) == 1
    assert read.doubts[0].startswith("rows without a usable pose: 1 of 48; line 8: ")
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
    assert read.doubts[0].startswith("rows without a usable pose: 2 of 48; line 4: ")
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


NAMED = {
    "evo": "timestamp,tx,ty,tz,qx,qy,qz,qw",
    "EuRoC": "#timestamp [ns], p_WS_x [m], p_WS_y [m], p_WS_z [m], q_WS_x [], q_WS_y [], q_WS_z [], q_WS_w []",
    "semicolons": "timestamp;tx;ty;tz;q.x;q.y;q.z;q.w",
    "blanks": "# time x y z qx qy qz qw",
    "unit after a blank": "# timestamp [s] x y z qx qy qz qw",
    "rostopic": "%time,field.pose.position.x,field.pose.position.y,field.pose.position.z,field.pose.orientation.x,"
    "field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w",
    "ROS": "header.stamp,pose.pose.position.x,pose.pose.position.y,pose.pose.position.z,pose.pose.orientation.x,"
    "pose.pose.orientation.y,pose.pose.orientation.z,pose.pose.orientation.w",
}


@pytest.mark.parametrize("name", NAMED)
def test_columns_are_found_by_their_names(name: str, tmp_path: Path) -> None:
    header = NAMED[name]
    separator = next((each for each in ",;" if each in header), " ")
    factor = 10**9 if "[ns]" in header or "%time" in header else 1
    file = write(tmp_path / "poses.csv", listed("w-last", separator, factor, header))
    same_poses(read_poses(file).of_images(COUNT, 100 + np.arange(COUNT) / 2, file), path())


@pytest.mark.parametrize(
    "order", [[4, 0, 3, 2, 1, 8, 7, 6, 5], [8, 7, 6, 5, 4, 3, 2, 1, 0], [1, 4, 2, 3, 5, 6, 7, 0, 8]]
)
def test_columns_may_be_in_any_order(order: str, tmp_path: Path) -> None:
    rows = [row.split(",") for row in listed("w-last", ",", 1, "timestamp,x,y,z,qx,qy,qz,qw").splitlines()]
    more = [[*row, "frame_id" if number == 0 else "world"] for number, row in enumerate(rows)]
    text = "".join(",".join(row[int(i)] for i in order) + "\n" for row in more)
    file = write(tmp_path / "poses.csv", text)
    same_poses(read_poses(file).of_images(COUNT, 100 + np.arange(COUNT) / 2, file), path())


def test_the_number_of_columns_tells_the_form(tmp_path: Path) -> None:
    for separator in (" ", ",", "; ", "\t"):
        same_poses(read_poses(write(tmp_path / "poses.csv", listed("w-last", separator))).poses, path())
    text = listed("w-first", ", ", 10**9)
    read = read_poses(write(tmp_path / "poses.csv", text), pose_form("euroc"))
    same_poses(read.poses, path())
    assert read.stamps is not None
    assert read.stamps[:2].tolist() == [100, 100.5]
    read = read_poses(write(tmp_path / "poses.csv", listed("w-first", ",", 1000)), pose_form("w-first,ms"))
    assert read.stamps is not None
    np.testing.assert_allclose(read.stamps[:2], [100, 100.5])


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
    with pytest.raises(InputError, match='"xyzw"'):
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
