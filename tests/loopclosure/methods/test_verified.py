"""Verification of another method's best matches, on walls seen from two sides."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.methods.base import Images, MethodContext, MethodResult, make_method
from loopclosure.methods.verified import Verified
from loopclosure.progress import silent
from tests.loopclosure.conftest import blots

WALLS = 6


class Fixed:
    """A method that always says the same."""

    name = "fixed"

    def __init__(self, scores):
        self.scores = scores

    def score(self, images, progress):
        return MethodResult(self.scores, {"fixed": 1.0}, ["as given"], ("training",))


@pytest.fixture(scope="module")
def walls(tmp_path_factory) -> list[Path]:
    """Six walls, and then the same six from a little beside."""
    folder = tmp_path_factory.mktemp("walls")
    corners = np.array([[0, 0], [320, 0], [320, 240], [0, 240]], np.float32)
    moved = np.array([[12, 6], [300, 18], [312, 228], [4, 236]], np.float32)
    paths = []
    for i in range(2 * WALLS):
        image = cv2.resize(blots(i % WALLS, 60, 80), (320, 240), interpolation=cv2.INTER_CUBIC)
        image = cv2.add(image, np.random.default_rng(i % WALLS).integers(0, 60, image.shape, np.uint8))
        if i >= WALLS:
            image = cv2.warpPerspective(image, cv2.getPerspectiveTransform(corners, moved), (320, 240))
        paths.append(folder / f"{i:02d}.png")
        cv2.imwrite(str(paths[-1]), cv2.GaussianBlur(image, (0, 0), 1.0))
    return paths


def accepted(scores):
    return [tuple(pair) for pair in np.argwhere(np.isfinite(scores)).tolist()]


def test_only_the_same_walls_are_accepted_with_their_inliers(walls):
    rng = np.random.default_rng(0)
    result = Verified(Fixed(rng.normal(size=(12, 12))), k=12).score(Images(walls), silent)
    assert accepted(result.scores) == [(i, i - WALLS) for i in range(WALLS, 2 * WALLS)]
    assert np.nanmin(result.scores) > 12 - 1
    assert list(result.seconds) == ["fixed", "local features", "verification"]
    assert result.training_stages == ("training",)
    assert result.notes[0] == "as given"
    assert result.notes[1].startswith("6 of the 66 best 12 pairs of each query accepted")


def test_only_the_best_k_of_each_query_are_examined(walls):
    scores = np.zeros((WALLS, WALLS))
    scores[range(WALLS), range(WALLS)] = np.array([-1, 1, 1, 1, 1, np.nan])
    result = Verified(Fixed(scores), k=1).score(Images(walls[WALLS:], walls[:WALLS]), silent)
    assert accepted(result.scores) == [(i, i) for i in range(1, 5)]


def test_excluded_frames_are_no_candidates(walls):
    method = Verified(Fixed(np.zeros((12, 12))), exclude_frames=WALLS)
    assert accepted(method.score(Images(walls), silent).scores) == []


def test_a_known_camera(walls):
    method = make_method("verified:focal_px=260,center_x_px=160,center_y_px=120,k=12+thumbnails", MethodContext())
    found = accepted(method.score(Images(walls), silent).scores)
    assert found == [(i, i - WALLS) for i in range(WALLS, 2 * WALLS)]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("verified", "write verified\\+METHOD"),
        ("verified:k=0+thumbnails", "k = 0; expected 1 or more"),
        ("verified:inliers=3+thumbnails", "expected at least 8"),
        ("verified:focal_px=300+thumbnails", "needs focal_px, center_x_px and center_y_px"),
        ("verified:depth=3+thumbnails", 'verified has no setting "depth=3"'),
    ],
)
def test_settings_that_make_no_sense(spec, message):
    with pytest.raises(InputError, match=message):
        make_method(spec)
