from pathlib import Path

import numpy as np
import pytest

from loopclosure.decision.trajectories import SequenceSettings, trajectory_costs
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, MethodContext, MethodResult, earlier
from loopclosure.methods.named import make_method
from loopclosure.methods.seqslam import (
    SeqSlam,
    enhance_contrast,
    least_cost_matches,
    standardize,
)
from loopclosure.progress import Progress, silent

OPEN_SEQSLAM = SequenceSettings(anchor="start", edges="drop")


def planted() -> np.ndarray:
    """Return distances (26 queries, 26 references) in which queries 8 to 23 pass references 0 to 15 again."""
    reference, query = np.mgrid[:26, :26]
    distances = 1 + ((7 * reference**2 + 13 * query + 5 * reference * query + 3 * query**2) % 23) / 23
    for q in range(8, 24):
        distances[q - 8, q] -= 0.9
    return distances.T


def noise_with_path(queries: int, references: int, path: list[tuple[int, int]], seed: int = 0) -> np.ndarray:
    distances = np.random.default_rng(seed).uniform(0.5, 1.5, (queries, references))
    for query, reference in path:
        distances[query, reference] = 0.3
    return distances


class Fixed:
    """A method that always says the same."""

    name = "fixed"

    def __init__(self, scores: np.ndarray) -> None:
        self.scores = scores

    def score(self, images: Images, progress: Progress) -> MethodResult:
        return MethodResult(self.scores, {"fixed": 1.0}, ["as given"])


def frames(count: int) -> list[Path]:
    return [Path(f"{i}.png") for i in range(count)]


def test_contrast_equals_the_reference() -> None:
    enhanced = enhance_contrast(planted(), 10)
    assert enhanced.sum() == pytest.approx(1803.062152404, abs=1e-8)
    np.testing.assert_allclose(
        enhanced[:6, 0], [1.3192073, 4.29075722, 3.31771609, 3.78610425, 1.98105652, 1.74793031], atol=1e-8
    )
    assert enhanced.min() == 0.0


def test_matches_equal_the_reference() -> None:
    match, ratio = least_cost_matches(trajectory_costs(enhance_contrast(planted(), 10), OPEN_SEQSLAM), window=10)
    expected = """5:7:.970799 6:8:.974159 7:19:.970108 8:7:.908976 9:7:.853456 10:8:.955933 11:5:.943301 12:5:.441713
        13:5:.403547 14:6:.295662 15:7:.290555 16:8:.303895 17:9:.226682 18:10:.160210 19:11:.242648 20:12:.279916"""
    found = [line.split(":") for line in expected.split()]
    judged = np.flatnonzero(match >= 0)
    np.testing.assert_array_equal(judged, [int(query) for query, _, _ in found])
    np.testing.assert_array_equal(match[judged], [int(reference) for _, reference, _ in found])
    np.testing.assert_allclose(ratio[judged], [float(score) for _, _, score in found], atol=1e-6)
    assert np.isnan(ratio[match < 0]).all()
    np.testing.assert_array_equal(judged[ratio[judged] < 0.45], np.arange(12, 21))


def test_contrast_of_equal_references_is_zero() -> None:
    np.testing.assert_array_equal(enhance_contrast(np.full((4, 9), 0.1), 4), 0.0)


def test_contrast_uses_valid_pairs_only() -> None:
    distances = np.random.default_rng(0).random((12, 12))
    valid = earlier(12, 2)
    changed = np.where(valid, distances, 1e6)
    np.testing.assert_allclose(enhance_contrast(changed, 6, valid), enhance_contrast(distances, 6, valid), atol=1e-12)
    np.testing.assert_array_equal(np.isnan(enhance_contrast(distances, 6, valid)), ~valid)


def test_contrast_without_any_valid_pair() -> None:
    assert np.isnan(enhance_contrast(np.ones((3, 3)), 4, np.zeros((3, 3), bool))).all()


def test_contrast_normalizes_a_query_that_differs_from_all_places() -> None:
    distances = noise_with_path(20, 20, [(i, i) for i in range(20)])
    distances[7] += 5.0  # a query that is unlike everything, say at night
    enhanced = enhance_contrast(distances, 10)
    assert enhanced[7].mean() == pytest.approx(enhanced[6].mean(), abs=0.5)


def test_shared_parts_of_trajectories_keep_the_means() -> None:
    random = np.random.default_rng(3)
    distances = np.where(random.random((150, 600)) < 0.02, np.nan, random.random((150, 600)))
    settings = SequenceSettings(length=21, slowest=0.5, fastest=2.0, velocity_step=0.25)
    around, expected = np.pad(distances, ((10, 11), (22, 22)), constant_values=np.nan), np.full((150, 600), np.inf)
    for path in settings.offsets():
        passed = np.array([around[k : k + 150, 22 + left : 622 + left] for k, left in enumerate(path)])
        enough = np.isfinite(passed).sum(axis=0) >= 11
        expected = np.fmin(expected, np.where(enough, np.nanmean(passed, axis=0), np.inf))
    costs = trajectory_costs(distances, settings)
    np.testing.assert_allclose(np.where(np.isnan(costs), np.inf, costs), expected, rtol=1e-12)
    np.testing.assert_array_equal(trajectory_costs(distances, settings, range(70, 140)), costs[70:140])


@pytest.mark.parametrize("velocity", [0.8, 1.0, 1.2])
@pytest.mark.parametrize("anchor", ["center", "start"])
def test_a_drive_at_another_speed_is_found(velocity: float, anchor: str) -> None:
    path = [(q, int(5 + velocity * q)) for q in range(30)]
    costs = trajectory_costs(noise_with_path(30, 45, path), SequenceSettings(anchor=anchor, edges="drop"))
    match, _ = least_cost_matches(costs)
    # From the start, half the length is added whatever the speed: one frame off at 0.8, and one by rounding.
    off = np.abs(match[5:25] - [reference for _, reference in path[5:25]])
    assert off.max() <= (1 if anchor == "center" else 2)


def test_a_reverse_drive_needs_both_directions() -> None:
    distances = noise_with_path(30, 30, [(q, 29 - q) for q in range(30)])
    for directions, found in (("forward", False), ("both", True)):
        settings = SequenceSettings(directions=directions, edges="drop")
        match, _ = least_cost_matches(trajectory_costs(distances, settings))
        assert np.all(match[5:25] == 29 - np.arange(5, 25)) == found


def test_trajectories_through_nan_have_no_cost() -> None:
    distances = np.random.default_rng(2).random((15, 15))
    distances[7, 7] = np.nan
    settings = SequenceSettings(length=4, slowest=1.0, fastest=1.0, edges="drop")
    costs = trajectory_costs(distances, settings)
    assert np.isnan(costs[[5, 6, 7, 8, 9], [5, 6, 7, 8, 9]]).all()
    assert np.isfinite(costs[[4, 10], [4, 10]]).all()


def test_uniqueness() -> None:
    costs = np.full((3, 20), 4.0)
    costs[0, 5] = 1.0
    costs[0, 10] = 2.0  # within the window of ten about 5: no rival
    costs[1, [2, 12]] = 0.0
    costs[2] = np.nan
    match, ratio = least_cost_matches(costs, window=10)
    np.testing.assert_array_equal(match, [5, 2, -1])
    np.testing.assert_array_equal(ratio, [0.25, 1.0, np.nan])


def test_earlier_frames() -> None:
    np.testing.assert_array_equal(np.argwhere(earlier(5, 2)), [[3, 0], [4, 0], [4, 1]])


def two_laps() -> np.ndarray:
    """Return scores (40, 40) of a sequence whose second half passes the first again; neighbors look alike too."""
    scores = -noise_with_path(40, 40, [(q, q - 20) for q in range(20, 40)])
    for gap in range(-3, 4):
        near = np.arange(max(0, gap), min(40, 40 + gap))
        scores[near, near - gap] = -0.1
    return scores


def test_one_sequence_never_matches_its_neighbors() -> None:
    method = SeqSlam(Fixed(two_laps()), exclude_frames=5)
    result = method.score(Images.of_files(frames(40)), silent)
    assert not np.isfinite(result.scores[~earlier(40, 5)]).any()
    best = np.argmax(np.nan_to_num(result.scores[20:], nan=-np.inf), axis=1)
    assert np.mean(best == np.arange(20)) > 0.9
    assert list(result.seconds) == ["fixed", "sequences"]
    assert "as given" in result.notes


def test_two_traverses_use_the_whole_matrix() -> None:
    scores = -noise_with_path(30, 30, [(q, q) for q in range(30)])
    noisy = scores + np.random.default_rng(9).normal(0, 0.3, scores.shape)
    alone = np.argmax(noisy, axis=1) == np.arange(30)
    result = SeqSlam(Fixed(noisy)).score(Images.of_files(frames(30), frames(30)), silent)
    together = np.argmax(np.nan_to_num(result.scores, nan=-np.inf), axis=1) == np.arange(30)
    assert together.mean() > 0.85 > 0.5 > alone.mean()  # what sequences are for


def test_uniqueness_as_the_score() -> None:
    result = SeqSlam(Fixed(two_laps()), exclude_frames=5, scored="uniqueness").score(
        Images.of_files(frames(40)), silent
    )
    assert np.all(np.isfinite(result.scores).sum(axis=1) <= 1)
    query, reference = np.argwhere(np.isfinite(result.scores)).T
    second = query >= 20
    assert np.mean(reference[second] == query[second] - 20) > 0.9
    assert result.scores[query[second], reference[second]].min() > 0.3


def test_uniqueness_of_scores_with_either_sign() -> None:
    log_odds = 40.0 * (two_laps() + 1.0)
    settings = SequenceSettings(contrast=0)
    result = SeqSlam(Fixed(log_odds), settings, scored="uniqueness", exclude_frames=5).score(
        Images.of_files(frames(40)), silent
    )
    found = result.scores[np.isfinite(result.scores)]
    assert len(found) > 20
    assert np.all((found >= 0) & (found <= 1))


def test_a_sequence_shorter_than_the_exclusion_has_no_scores() -> None:
    for settings in (SequenceSettings(), SequenceSettings(contrast=0)):
        for scored in ("cost", "uniqueness"):
            method = SeqSlam(Fixed(np.zeros((4, 4))), settings, scored, exclude_frames=5)
            assert np.isnan(method.score(Images.of_files(frames(4)), silent).scores).all()


def test_the_command_line_builds_it() -> None:
    method = make_method(
        "seqslam",
        MethodContext(exclude_frames=7),
        {"seqslam.length": "6", "seqslam.directions": "both", "seqslam.width": "32", "seqslam.patch": "4"},
    )
    assert isinstance(method, SeqSlam)
    assert (method.settings.length, method.settings.directions, method.exclude_frames) == (6, "both", 7)
    assert method.name == "seqslam"
    on_words = make_method("seqslam+bow", settings={"seqslam.length": "4", "bow.words": "50"})
    assert isinstance(on_words, SeqSlam)
    assert on_words.name == "seqslam+bow"
    assert (on_words.settings.contrast, on_words.settings.length, on_words.standardize) == (0, 4, "traverses")


def another_season() -> np.ndarray:
    """Return scores (30, 30) of a route driven twice, in which references 8 to 15 resemble every query."""
    rng = np.random.default_rng(4)
    scores = rng.normal(0, 0.3, (30, 30)) + np.eye(30)
    scores[:, 8:16] += 3.0
    return scores + rng.normal(0, 2, (30, 1))


def right(scores: np.ndarray) -> float:
    return float(np.mean(np.argmax(np.nan_to_num(scores, nan=-np.inf), axis=1) == np.arange(len(scores))))


def test_standardization_reduces_references_similar_to_all_queries() -> None:
    pictures = Images.of_files(frames(30), frames(30))
    plain = SeqSlam(Fixed(another_season()), SequenceSettings(contrast=0))
    scaled = SeqSlam(Fixed(another_season()), SequenceSettings(contrast=0), standardize="traverses")
    assert right(plain.score(pictures, silent).scores) < 0.3 < 0.9 < right(scaled.score(pictures, silent).scores)
    one_sequence = Images.of_files(frames(30))
    np.testing.assert_array_equal(plain.score(one_sequence, silent).scores, scaled.score(one_sequence, silent).scores)


def test_standardized_distances() -> None:
    scaled = standardize(np.array([[1.0, 2.0, np.nan], [5.0, 5.0, 5.0], [0.0, 6.0, 3.0]]))
    assert np.isnan(scaled[0, 2])
    known = np.isfinite(scaled)
    np.testing.assert_allclose([scaled[known[:, j], j].mean() for j in range(3)], 0, atol=1e-12)
    np.testing.assert_allclose(scaled[:, 0].std(), 1)


def test_small_deviations_are_raised_to_the_usual_one() -> None:
    """Rows of deviation 1, 3 and 9, then three columns that differ as much."""
    rows = np.array([[-1.0, 1.0, 0.0], [-3.0, 0.0, 3.0], [0.0, 9.0, -9.0]]) * np.sqrt(1.5)
    usual = rows / [[3], [3], [9]]
    usual -= usual.mean(axis=0)
    deviations = usual.std(axis=0)
    expected = usual / np.maximum(deviations, np.median(deviations))
    np.testing.assert_allclose(standardize(rows, usual=True), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"directions": "backward"}, 'directions of SeqSLAM is "backward"; expected forward or both'),
        ({"anchor": "end"}, "anchor of SeqSLAM"),
        ({"edges": "pad"}, "edges of SeqSLAM"),
        ({"length": 0}, "length 1 to 10000"),
        ({"length": 10**20}, "length 1 to 10000"),
        ({"slowest": 2.0}, "slowest <= fastest"),
    ],
)
def test_invalid_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        SequenceSettings(**settings)


def test_an_unknown_way_to_standardize() -> None:
    with pytest.raises(InputError, match='standardize of SeqSLAM is "rows"; expected no, yes, traverses'):
        make_method("seqslam+thumbnails", settings={"seqslam.standardize": "rows"})


def test_an_unknown_score() -> None:
    with pytest.raises(InputError, match='"cost" or "uniqueness", not "ratio"'):
        SeqSlam(Fixed(np.eye(2)), scored="ratio")
