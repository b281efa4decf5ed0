"""The rule for the same place: its limits, and that a pair gives the same result as a matrix."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopclosure.places.datasets import load_sequence
from loopclosure.places.same_place import (
    angles_deg,
    distances_m,
    same_place,
    same_place_matrix,
    view_angles_deg,
)
from loopclosure.places.sequences import read_sequence
from paths import shared

ORIGIN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def pose(x: float = 0.0, turn_deg: float = 0.0, axis: str = "y") -> np.ndarray:
    return np.append([x, 0.0, 0.0], Rotation.from_euler(axis, turn_deg, degrees=True).as_quat())


def random_poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    positions = rng.normal(0, 1.5, (count, 3))
    return np.hstack([positions, Rotation.from_euler("xyz", rng.normal(0, 8, (count, 3)), True).as_quat()])


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
    flipped = np.append(turned[:3], -turned[3:])
    np.testing.assert_allclose(angles_deg(turned, flipped), 0, atol=1e-6)
    np.testing.assert_allclose(angles_deg(ORIGIN, flipped), 30)


def test_a_matrix_equals_its_single_pairs() -> None:
    a, b = random_poses(37), random_poses(23, seed=1)
    truth = same_place_matrix(a, b)
    one_by_one = [[bool(same_place(a[i], b[j])) for j in range(23)] for i in range(37)]
    assert truth.tolist() == one_by_one
    assert 0 < truth.mean() < 1
    np.testing.assert_allclose(distances_m(a[3], b), np.linalg.norm(a[3, :3] - b[:, :3], axis=1))


def test_the_matrix_does_not_depend_on_the_block_size() -> None:
    a, b = random_poses(37), random_poses(23, seed=1)
    for pairs_at_once in (1, 23 * 5, 10_000):
        assert np.array_equal(same_place_matrix(a, b, pairs_at_once=pairs_at_once), same_place_matrix(a, b))


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


def test_queries_in_another_recording_of_the_same_place(two_laps):
    data = load_sequence(laps := read_sequence(two_laps, "tum"), references=laps)
    assert data.wide is not None
    assert data.truth.hard.shape == data.wide.hard.shape == (40, 40)
    assert data.truth.judged.all()
    assert data.truth.hard.diagonal().all()
    assert data.name == "two_laps in two_laps"
