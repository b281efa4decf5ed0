"""Verification of another method's best matches, on walls seen from two sides."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.decision.trajectories import SequenceSettings
from loopclosure.detector.verification import Agreement, GeometricCheck
from loopclosure.methods.base import Images, MethodContext, MethodResult
from loopclosure.methods.named import make_method
from loopclosure.methods.seqslam import SeqSlam
from loopclosure.methods.verified import Verified, on_trajectories
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


def first(scores, given):
    """The pairs that come before all others."""
    most = np.nanmax(given) + 0.5
    return [tuple(pair) for pair in np.argwhere(np.nan_to_num(scores, nan=-np.inf) > most).tolist()]


@pytest.mark.slow
def test_verified_matches_come_first_and_others_keep_their_order(walls):
    rng = np.random.default_rng(0)
    given = rng.normal(size=(12, 12))
    result = Verified(Fixed(given), k=12).score(Images.of_files(walls), silent)
    loops = [(i, i - WALLS) for i in range(WALLS, 2 * WALLS)]
    assert first(result.scores, given) == loops
    order = sorted(loops, key=lambda pair: given[pair])
    assert sorted(loops, key=lambda pair: result.scores[pair]) == order
    others = np.tri(12, k=-1, dtype=bool)
    others[tuple(np.transpose(loops))] = False
    np.testing.assert_array_equal(result.scores[others], given[others])
    by_inliers = Verified(Fixed(given), k=12, order="inliers").score(Images.of_files(walls), silent).scores
    assert accepted(by_inliers) == loops
    assert np.nanmin(by_inliers) >= 8
    assert list(result.seconds) == ["fixed", "local features", "verification"]
    assert result.training_stages == ("training",)
    assert result.notes[0] == "as given"
    assert result.notes[1].startswith("6 of 66 pairs, the best 12 of each query, are verified")


@pytest.mark.slow
def test_only_the_best_k_of_each_query_are_examined(walls):
    scores = np.zeros((WALLS, WALLS))
    scores[range(WALLS), range(WALLS)] = np.array([-1, 1, 1, 1, 1, np.nan])
    result = Verified(Fixed(scores), k=1).score(Images.of_files(walls[WALLS:], walls[:WALLS]), silent)
    assert first(result.scores, scores) == [(i, i) for i in range(1, 5)]


def test_images_that_cannot_be_verified_keep_their_scores(walls):
    blank = walls[0].parent / "gray.png"
    cv2.imwrite(str(blank), np.full((240, 320, 3), 90, np.uint8))
    given = np.random.default_rng(0).normal(size=(6, 6))
    result = Verified(Fixed(given)).score(Images.of_files([blank] * 6, walls[:6]), silent)
    np.testing.assert_array_equal(result.scores, given)
    assert result.notes[-1].startswith("these images cannot be verified")


@pytest.mark.parametrize(("inliers", "best"), [(17, 0), (26, 1)])
def test_few_inliers_do_not_override_a_score(walls, inliers, best):
    given = np.array([[0.9, 0.5, 0.1]])
    method = Verified(Fixed(given), k=3)
    images = Images.of_files(walls[:1], walls[1:4])
    for reference, found in zip(walls[1:4], ((7, 0), (26, inliers), (5, 0)), strict=True):
        method.pairs._found[method.check, walls[0], reference] = Agreement(*found, 17)
    assert np.nanargmax(method.score(images, silent).scores) == best


@pytest.mark.slow
def test_results_of_another_method_are_reused(walls, monkeypatch):
    context = MethodContext()
    images = Images.of_files(walls[WALLS:], walls[:WALLS])
    scores = make_method("verified+thumbnails", context, {"verified.k": "6"}).score(images, silent).scores
    monkeypatch.setattr(GeometricCheck, "describe", None)
    monkeypatch.setattr(GeometricCheck, "agreement", None)
    again = make_method("verified+thumbnails", context, {"verified.k": "6"}).score(images, silent).scores
    np.testing.assert_array_equal(scores, again)


@pytest.mark.slow
def test_on_top_of_seqslam_a_sequence_is_verified(walls):
    given = np.where(np.subtract.outer(np.arange(12), np.arange(12)) == WALLS, 1.0, -1.0)
    blank = walls[0].parent / "blank.png"
    cv2.imwrite(str(blank), np.full((240, 320, 3), 90, np.uint8))
    partly = [*walls[:8], blank, *walls[9:]]  # what the third frame of the second lap shows has no features
    alone = Verified(Fixed(given), k=1).score(Images.of_files(partly), silent)
    assert (8, 2) not in first(alone.scores, given)
    sequences = Verified(SeqSlam(Fixed(given), SequenceSettings(length=4, contrast=0)), k=1)
    together = first(sequences.score(Images.of_files(partly), silent).scores, given)
    assert {(i, i - WALLS) for i in range(WALLS, 2 * WALLS)} <= set(together)
    assert (11, 1) not in together
    ended = [*walls[:11], blank]  # past the last verified pair the line goes on, but not the loop
    assert (11, 5) not in first(sequences.score(Images.of_files(ended), silent).scores, given)


def test_trajectories_support_their_matches():
    seen = np.zeros((9, 9), bool)
    seen[4, 3] = True
    offsets = SequenceSettings(length=4, slowest=1.0, fastest=1.0).offsets()
    assert accepted(np.where(on_trajectories(seen, offsets), 1, np.nan)) == [(2, 1), (3, 2), (4, 3), (5, 4), (6, 5)]
    both = SequenceSettings(length=2, slowest=1.0, fastest=1.0, directions="both").offsets()
    assert accepted(np.where(on_trajectories(seen, both), 1, np.nan)) == [(3, 2), (3, 4), (4, 3), (5, 2), (5, 4)]


@pytest.mark.slow
def test_excluded_frames_are_not_candidates(walls):
    method = Verified(Fixed(np.zeros((12, 12))), exclude_frames=WALLS)
    assert [i - j for i, j in accepted(method.score(Images.of_files(walls), silent).scores) if i - j <= WALLS] == []


@pytest.mark.slow
def test_a_known_camera(walls):
    settings = {"focal_px": "260", "center_x_px": "160", "center_y_px": "120", "k": "12"}
    method = make_method("verified+thumbnails", settings={f"verified.{key}": v for key, v in settings.items()})
    found = first(method.score(Images.of_files(walls), silent).scores, np.zeros(1))
    assert found == [(i, i - WALLS) for i in range(WALLS, 2 * WALLS)]
