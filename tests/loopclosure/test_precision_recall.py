"""Precision and recall: a worked example, counting by hand, and scikit-learn."""

import numpy as np
import pytest
from sklearn.metrics import average_precision_score, precision_recall_curve

from loopclosure.errors import InputError
from loopclosure.places.truth import Exclusion, sequence_truth, traverse_truth
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH, JudgedScores, curve

# The worked example: rows are the data base's five places, columns the four queries.
SCORES = np.array(
    [
        [0.95, 0.20, 0.55, 0.10],
        [0.40, 0.90, 0.30, 0.35],
        [0.30, 0.85, 0.60, 0.25],
        [0.15, 0.05, 0.80, 0.45],
        [0.10, 0.50, 0.70, 0.65],
    ]
).T
TRUE_PAIRS = [(0, 0), (1, 1), (2, 1), (4, 2)]


def example_truth(soft=()):
    hard = np.zeros((4, 5), dtype=bool)
    near = np.zeros((4, 5), dtype=bool)
    for place, query in TRUE_PAIRS:
        hard[query, place] = True
    for place, query in soft:
        near[query, place] = True
    return traverse_truth(hard, "the worked example", soft=near)


def test_the_example_over_all_pairs():
    found = JudgedScores(SCORES, example_truth()).all_pairs_curve()
    assert found.convention == ALL_PAIRS
    assert found.average_precision == pytest.approx(0.95)
    precision, recall = np.append(1, found.precision), np.append(0, found.recall)
    assert np.sum(np.diff(recall) * (precision[1:] + precision[:-1]) / 2) == pytest.approx(0.94375)  # the trapezoid
    assert found.recall_at_full_precision == 0.75
    np.testing.assert_allclose(found.thresholds[:5], [0.95, 0.9, 0.85, 0.8, 0.7])
    np.testing.assert_allclose(found.precision[:5], [1, 1, 1, 0.75, 0.8])
    np.testing.assert_allclose(found.recall[:5], [0.25, 0.5, 0.75, 0.75, 1])
    assert (found.positives, found.samples) == (4, 20)


def test_the_example_by_best_match():
    matches = JudgedScores(SCORES, example_truth()).best_matches
    assert list(matches.reference) == [0, 1, 3, 4]
    assert list(matches.right) == [True, True, False, False]
    found = JudgedScores(SCORES, example_truth()).best_match_curve()
    assert found.convention == BEST_MATCH
    assert found.positives == 3
    assert found.recall_at_full_precision == pytest.approx(2 / 3)
    assert found.precision[-1] == 0.5
    assert found.recall[-1] == pytest.approx(2 / 3)


def test_recall_at_k_of_the_example():
    found = JudgedScores(SCORES, example_truth()).recall_at((1, 2, 3, 99))
    assert found == {1: pytest.approx(2 / 3), 2: 1.0, 3: 1.0, 99: 1.0}


@pytest.mark.parametrize("seed", range(4))
def test_curve_equals_scikit_learn(seed):
    rng = np.random.default_rng(seed)
    right = rng.random(500) < 0.1
    scores = np.round(rng.normal(right, 1.0), 1)  # rounding makes ties
    found = curve(scores, right)
    precision, recall, thresholds = precision_recall_curve(right, scores)
    np.testing.assert_array_equal(found.thresholds, thresholds[::-1])
    np.testing.assert_allclose(found.precision, precision[:-1][::-1])
    np.testing.assert_allclose(found.recall, recall[:-1][::-1])
    assert found.average_precision == pytest.approx(average_precision_score(right, scores))


def test_ties_are_one_point_in_any_order():
    found = curve(np.array([0.5, 0.5, 0.5]), np.array([True, False, True]))
    assert list(found.precision) == [pytest.approx(2 / 3)]
    assert found.recall_at_full_precision == 0.0


def test_a_pair_without_a_score_can_still_be_missed():
    truth = example_truth()
    scores = SCORES.copy()
    scores[2, 4] = np.nan  # the loop of query 2
    assert JudgedScores(scores, truth).all_pairs_curve().recall[-1] == 0.75
    scores[2] = np.nan
    matches = JudgedScores(scores, truth).best_matches
    assert matches.reference[2] == -1
    assert not matches.right[2]
    assert JudgedScores(scores, truth).recall_at((5,)) == {5: pytest.approx(2 / 3)}


def test_soft_pairs_are_ignored_over_all_pairs():
    # query 2's best reference, place 3, lies beside its true place
    found = JudgedScores(SCORES, example_truth(soft=[(3, 2)])).all_pairs_curve()
    assert found.samples == 19
    assert found.recall_at_full_precision == 1.0


def test_soft_best_match_is_right_with_a_loop_and_ignored_without():
    matches = JudgedScores(SCORES, example_truth(soft=[(3, 2), (4, 3)])).best_matches
    assert list(matches.right) == [True, True, True, False]
    assert list(matches.ignored) == [False, False, False, True]
    found = JudgedScores(SCORES, example_truth(soft=[(3, 2), (4, 3)])).best_match_curve()
    assert (found.samples, found.recall_at_full_precision) == (3, 1.0)


def test_one_sequence_is_judged_below_the_diagonal_and_outside_the_exclusion():
    hard = np.ones((5, 5), dtype=bool)
    truth = sequence_truth(hard, Exclusion(frames=2), "all one place")
    assert {(3, 0), (4, 0), (4, 1)} == {(int(i), int(j)) for i, j in np.argwhere(truth.judged)}
    assert truth.positives == 3
    assert list(truth.queries_with_a_loop) == [False, False, False, True, True]
    assert "at most 2 frames apart" in truth.description
    scores = np.arange(25.0).reshape(5, 5)
    assert list(JudgedScores(scores, truth).best_matches.reference) == [-1, -1, -1, 0, 1]
    assert JudgedScores(scores, truth).all_pairs_curve().truth_description == truth.description


def test_seconds_exclude_by_stamps():
    truth = sequence_truth(np.ones((4, 4), bool), Exclusion(seconds=1.5), "x", stamps=np.array([0.0, 1.0, 2.0, 9.0]))
    assert {(2, 0), (3, 0), (3, 1), (3, 2)} == {(int(i), int(j)) for i, j in np.argwhere(truth.judged)}
    with pytest.raises(InputError, match="the frames have no time"):
        sequence_truth(np.ones((4, 4), bool), Exclusion(seconds=1.5), "x")


def test_best_f1():
    found = JudgedScores(SCORES, example_truth()).all_pairs_curve()
    assert found.best_f1 == pytest.approx(2 * 0.8 / 1.8)
    assert found.best_f1_threshold == 0.7


def test_without_loops_metrics_are_nan():
    found = curve(np.array([0.9, 0.1]), np.array([False, False]))
    assert np.isnan(found.average_precision)
    assert np.isnan(found.best_f1)
    assert np.isnan(found.recall_at_full_precision)
    assert curve(np.zeros(0), np.zeros(0, bool)).samples == 0
