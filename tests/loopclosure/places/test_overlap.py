"""Which views overlap: by assumed distances, and by measured depth."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.datasets import load_sequence
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.overlap import ViewOverlap, overlap_matrix, views
from loopclosure.places.sequences import read_sequence
from loopclosure.places.trajectory import Poses


def camera(position=(0.0, 0.0, 0.0), turn_deg=0.0):
    """A camera that looks along +z of the world, turned about its vertical axis y."""
    return np.array(position, float), Rotation.from_euler("y", turn_deg, degrees=True).as_quat()


def poses(*cameras):
    positions, quaternions = zip(*cameras, strict=True)
    return Poses(np.array(positions), np.array(quaternions))


def overlapping(a, b, **settings):
    return bool(overlap_matrix(views(poses(a)), views(poses(b)), ViewOverlap(**settings))[0, 0])


@pytest.mark.parametrize(
    ("other", "same"),
    [
        (camera(), True),
        (camera(turn_deg=30), True),  # of 60 degrees of view
        (camera(turn_deg=50), False),
        (camera(turn_deg=180), False),
        (camera((1.5, 0, 0)), True),  # beside
        (camera((8, 0, 0)), False),
        (camera((0, 0, 1)), True),  # ahead
        (camera((0, 0, 6)), False),
        (camera((0, 0, 30)), False),
    ],
)
def test_views_of_one_camera(other, same):
    assert overlapping(camera(), other) == overlapping(other, camera()) == same


def test_a_wider_camera_sees_more():
    turned = camera(turn_deg=50)
    assert overlapping(camera(), turned, fov_deg=100)
    assert overlapping(camera(), turned, least=0.05)
    assert not overlapping(camera(), camera(turn_deg=30), least=0.6)


def test_measured_depth_tells_a_far_wall_from_a_near_one(tmp_path):
    far, near = tmp_path / "far.png", tmp_path / "near.png"
    cv2.imwrite(str(far), np.full((48, 64), 5000 * 12, np.uint16))
    cv2.imwrite(str(near), np.full((48, 64), 5000 * 1, np.uint16))
    beside = poses(camera(), camera((4, 0, 0)))
    wall = overlap_matrix(views(beside, [far, far]), views(beside, [far, far]))
    assert wall.all()
    assert not overlap_matrix(views(beside, [near, near]), views(beside, [near, near]))[0, 1]
    # What one camera sees at 12 m is hidden from the other, which stands in front of a box.
    assert not overlap_matrix(views(beside, [far, near]), views(beside, [far, near]))[0, 1]
    none = views(beside, [None, None])
    assert not none.measured.any()


def test_what_is_no_depth_image(tmp_path):
    color = tmp_path / "color.png"
    cv2.imwrite(str(color), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(InputError, match="is not a depth image"):
        views(poses(camera()), [color])


@pytest.mark.parametrize("settings", [{"fov_deg": 0.0}, {"fov_deg": 180.0}, {"least": 0.0}, {"least": 1.1}])
def test_settings_that_make_no_sense(settings):
    with pytest.raises(InputError, match=r"expected 0\.\.180"):
        ViewOverlap(**settings)


def test_a_sequence_with_depth_says_so(two_laps, tmp_path):
    folder = tmp_path / "with_depth"
    folder.mkdir()
    (folder / "rgb").symlink_to(two_laps / "rgb")
    for name in ("rgb.txt", "groundtruth.txt"):
        (folder / name).write_text((two_laps / name).read_text())
    assert "measured" not in load_sequence(read_sequence(folder, "tum")).overlap_rule
    (folder / "depth").mkdir()
    cv2.imwrite(str(folder / "depth" / "0.png"), np.full((48, 64), 15000, np.uint16))
    (folder / "depth.txt").write_text("\n".join(f"{i}.01 depth/0.png" for i in range(30)) + "\n")
    data = load_sequence(read_sequence(folder, "tum"))
    assert "by the poses and measured depth, or assumed distances of 2, 4, 8 m where it is missing" in data.overlap_rule
    assert data.soft_truth is not None
    assert (data.soft_truth.soft | ~data.truth.hard).all()


def test_the_field_of_view_is_the_cameras_where_it_is_known():
    wide = Intrinsics(40, 40, 32, 24, size=(64, 48))
    assert ViewOverlap().of_camera(wide).fov == pytest.approx(77.32, abs=0.01)
    assert ViewOverlap(50).of_camera(wide).fov == 50
    assert ViewOverlap().of_camera(Intrinsics(40, 40, 32, 24)).fov == ViewOverlap().of_camera(None).fov == 60


def test_queries_in_another_recording_of_the_same_place(two_laps):
    data = load_sequence(laps := read_sequence(two_laps, "tum"), references=laps)
    assert data.overlap is not None
    assert data.truth.hard.shape == data.overlap.shape == (40, 40)
    assert data.truth.judged.all()
    assert data.truth.hard.diagonal().all()
    assert data.name == "two_laps in two_laps"
