"""The rule for the same place: its limits, and that a pair gives the same result as a matrix."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.datasets import load_sequence
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.overlap import ViewOverlap, overlap_matrix, views
from loopclosure.places.same_place import (
    angles_deg,
    distances_m,
    same_place,
    same_place_blocks,
    same_place_matrix,
    view_angles_deg,
)
from loopclosure.places.sequences import read_sequence
from loopclosure.places.trajectory import Poses
from paths import shared

ORIGIN = Poses(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


def pose(x: float = 0.0, turn_deg: float = 0.0, axis: str = "y") -> Poses:
    return Poses(np.array([x, 0.0, 0.0]), Rotation.from_euler(axis, turn_deg, degrees=True).as_quat())


def random_poses(count: int, seed: int = 0) -> Poses:
    rng = np.random.default_rng(seed)
    return Poses(
        rng.normal(0, 1.5, (count, 3)), Rotation.from_euler("xyz", rng.normal(0, 8, (count, 3)), True).as_quat()
    )


@pytest.mark.parametrize(
    ("x", "turn", "same"), [(1.9999, 0, True), (2.0, 0, False), (0, 14.999, True), (0, 15.001, False), (3, 0, False)]
)
def test_both_limits_are_strict(x: float, turn: float, same: bool) -> None:
    assert bool(same_place(ORIGIN, pose(x, turn))) is same


def test_distance_and_angle_must_both_be_small() -> None:
    assert not same_place(ORIGIN, pose(1.0, 20.0))
    assert not same_place(ORIGIN, pose(2.5, 5.0))
    assert same_place(ORIGIN, pose(2.5, 20.0), max_distance_m=3, max_angle_deg=30)


def test_the_view_angle_ignores_roll() -> None:
    np.testing.assert_allclose(angles_deg(ORIGIN, pose(turn_deg=70, axis="z")), 70)
    np.testing.assert_allclose(view_angles_deg(ORIGIN, pose(turn_deg=70, axis="z")), 0, atol=1e-6)
    np.testing.assert_allclose(view_angles_deg(ORIGIN, pose(turn_deg=70, axis="x")), 70)
    np.testing.assert_allclose(angles_deg(ORIGIN, pose(turn_deg=170, axis="y")), 170)


def test_a_quaternion_and_its_negative_are_the_same_rotation() -> None:
    turned = pose(turn_deg=30)
    flipped = Poses(turned.positions, -turned.quaternions)
    np.testing.assert_allclose(angles_deg(turned, flipped), 0, atol=1e-6)
    np.testing.assert_allclose(angles_deg(ORIGIN, flipped), 30)


def test_a_matrix_equals_its_single_pairs() -> None:
    a, b = random_poses(37), random_poses(23, seed=1)
    truth = same_place_matrix(a, b)
    one_by_one = [[bool(same_place(a[i], b[j])) for j in range(23)] for i in range(37)]
    assert truth.tolist() == one_by_one
    assert 0 < truth.mean() < 1
    np.testing.assert_allclose(distances_m(a[3], b), np.linalg.norm(a.positions[3] - b.positions, axis=1))


def test_the_matrix_does_not_depend_on_the_block_size() -> None:
    a, b = random_poses(37), random_poses(23, seed=1)
    for pairs_at_once in (1, 23 * 5, 10_000):
        blocks = list(same_place_blocks(a, b, pairs_at_once=pairs_at_once))
        assert [rows.start for rows, _ in blocks] == [0, *(rows.stop for rows, _ in blocks[:-1])]
        assert np.array_equal(np.vstack([block for _, block in blocks]), same_place_matrix(a, b))


def test_the_rule_is_symmetric() -> None:
    poses = random_poses(40)
    truth = same_place_matrix(poses, poses)
    assert np.array_equal(truth, truth.T)
    assert truth.diagonal().all()


@pytest.mark.slow
def test_fr1_rpy_has_the_clear_negatives_its_readme_counts_and_xyz_none() -> None:
    folder = shared("data", "tum_fr1")
    for name, clear in (("rpy", 20_101), ("xyz", 0)):
        poses = read_sequence(folder / f"rgbd_dataset_freiburg1_{name}", "tum", 0.03).with_poses().known_poses()
        first, second = np.triu_indices(len(poses), 1)
        assert int(np.sum(view_angles_deg(poses[first], poses[second]) > 50)) == clear
        assert distances_m(poses[first], poses[second]).max() < 0.71


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


def test_a_wider_field_of_view_overlaps_more():
    turned = camera(turn_deg=50)
    assert overlapping(camera(), turned, fov_deg=100)
    assert overlapping(camera(), turned, least=0.05)
    assert not overlapping(camera(), camera(turn_deg=30), least=0.6)


def test_depth_distinguishes_near_and_far_walls(tmp_path):
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


def test_an_invalid_depth_image_is_refused(tmp_path):
    color = tmp_path / "color.png"
    cv2.imwrite(str(color), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(InputError, match="is not a depth image"):
        views(poses(camera()), [color])


@pytest.mark.parametrize("settings", [{"fov_deg": 0.0}, {"fov_deg": 180.0}, {"least": 0.0}, {"least": 1.1}])
def test_invalid_settings_are_refused(settings):
    with pytest.raises(InputError, match=r"expected 0\.\.180"):
        ViewOverlap(**settings)


def test_depth_of_a_sequence_determines_its_overlap_rule(two_laps, tmp_path):
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


def test_the_field_of_view_comes_from_the_camera_if_known():
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
