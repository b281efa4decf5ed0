"""Views in other light: each change keeps the picture's form, depends on the generator alone, and really changes."""

import cv2
import numpy as np
import pytest

from lmdb_build.light import change_light


@pytest.fixture
def view() -> np.ndarray:
    rng = np.random.default_rng(1)
    return cv2.resize(rng.integers(40, 216, (6, 8, 3), np.uint8), (64, 48), interpolation=cv2.INTER_CUBIC)


def test_a_view_changes_with_the_generator_alone(view: np.ndarray) -> None:
    other, before = view[::-1].copy(), view.copy()
    found = [change_light(view, lambda: other, np.random.default_rng(seed)) for seed in range(40)]
    assert all(each.shape == view.shape and each.dtype == np.uint8 for each in found)
    assert len({each.tobytes() for each in found}) == 40
    np.testing.assert_array_equal(found[7], change_light(view, lambda: other, np.random.default_rng(7)))
    np.testing.assert_array_equal(view, before)


def test_most_views_can_still_be_recognized(view: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    like = [
        np.corrcoef(view.mean(axis=2).ravel(), change_light(view, lambda: view, rng).mean(axis=2).ravel())[0, 1]
        for _ in range(200)
    ]
    assert np.median(like) > 0.5
    assert np.mean(np.array(like) < 0.95) > 0.3


def test_a_small_picture_in_front_is_cut_to_its_size(view: np.ndarray) -> None:
    dark = np.zeros((5, 7, 3), np.uint8)
    assert any((change_light(view, lambda: dark, np.random.default_rng(seed)) == 0).any() for seed in range(40))


def test_calm_views_keep_their_colors(view: np.ndarray) -> None:
    gray = np.repeat(view[..., :1], 3, axis=2)
    other = np.dstack([np.full((48, 64), 255), np.zeros((48, 64)), np.zeros((48, 64))]).astype(np.uint8)
    for calm, most, least in ((1.0, 0, 0), (0.0, 200, 30)):
        found = [change_light(gray, lambda: other, np.random.default_rng(seed), calm) for seed in range(100)]
        colored = sum(bool(np.ptp(each.astype(int), axis=2).any()) for each in found)
        assert least <= colored <= most
