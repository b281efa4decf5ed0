"""The figures of the paper's Table I, against counting by hand and against scikit-learn."""

import re

import numpy as np
import pytest
from sklearn.metrics import accuracy_score, f1_score, precision_score, recall_score, roc_auc_score

from loopclosure.errors import InputError
from loopclosure.report.table_one import (
    Run,
    best_threshold,
    metrics_at,
    pair_distances,
    roc_auc,
    summary,
)


def test_distances_of_pairs():
    a = np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 4.0]])
    b = np.array([[3.0, 4.0], [0.0, 2.0], [3.0, 4.0]])
    np.testing.assert_allclose(pair_distances(a, b), [5.0, np.sqrt(5.0), 0.0])


def test_distances_flatten_blobs_of_four_axes():
    a = np.arange(12, dtype=np.float32).reshape(2, 3, 2, 1)
    np.testing.assert_allclose(pair_distances(a, np.zeros_like(a)), np.linalg.norm(a.reshape(2, 6), axis=1))


def test_the_smallest_of_equally_good_thresholds_is_chosen():
    # calling one pair the same or three is right three times of four
    assert best_threshold(np.array([0.1, 0.2, 0.3, 0.4]), np.array([1, 0, 1, 0])) == pytest.approx(0.15)


def test_all_or_no_pairs_can_be_positive():
    distances = np.array([0.2, 0.4])
    assert metrics_at(best_threshold(distances, np.array([1, 1])), distances, np.array([1, 1])).recall == 1.0
    assert metrics_at(best_threshold(distances, np.array([0, 0])), distances, np.array([0, 0])).accuracy == 1.0


def test_neighboring_floats_are_distinguished():
    low = 1.0
    high = np.nextafter(low, 2.0)
    distances, labels = np.array([low, high]), np.array([1, 0])
    assert metrics_at(best_threshold(distances, labels), distances, labels).accuracy == 1.0


@pytest.mark.parametrize("seed", range(5))
def test_the_threshold_is_optimal(seed):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 2, 60)
    distances = np.round(rng.normal(1.0 - 0.5 * labels, 0.4), 1)  # rounding makes ties
    tried = [np.mean((distances < t) == labels) for t in np.linspace(-1, 3, 4001)]
    assert metrics_at(best_threshold(distances, labels), distances, labels).accuracy == pytest.approx(max(tried))


def test_figures_agree_with_scikit_learn():
    rng = np.random.default_rng(3)
    train_labels, labels = rng.integers(0, 2, 200), rng.integers(0, 2, 300)
    train = np.round(rng.normal(1.0 - 0.4 * train_labels, 0.4), 2)
    test = np.round(rng.normal(1.0 - 0.4 * labels, 0.4), 2)
    found = metrics_at(best_threshold(train, train_labels), test, labels)
    called = test < found.threshold
    assert found.precision == pytest.approx(precision_score(labels, called))
    assert found.recall == pytest.approx(recall_score(labels, called))
    assert found.accuracy == pytest.approx(accuracy_score(labels, called))
    assert found.f1 == pytest.approx(f1_score(labels, called))
    assert found.roc_auc == pytest.approx(roc_auc_score(labels, -test))


def test_shares_without_a_denominator_are_nan():
    found = metrics_at(0.0, np.array([0.5, 0.6]), np.array([1, 1]))
    assert np.isnan(found.precision)
    assert found.recall == 0.0
    assert np.isnan(roc_auc(np.array([0.5, 0.6]), np.array([1, 1])))


@pytest.mark.parametrize(
    ("distances", "labels", "sentence"),
    [
        ([0.1, np.nan], [1, 0], "1 of 2 distances are NaN or infinite"),
        ([0.1, 0.2], [1], "2 distances but 1 labels"),
        ([0.1, 0.2], [1, 2], "a label is 2"),
        ([], [], "no pairs to judge"),
    ],
)
def test_errors_are_reported(distances, labels, sentence):
    with pytest.raises(InputError, match=sentence):
        best_threshold(np.array(distances), np.array(labels))


def test_unequal_features_are_refused():
    with pytest.raises(InputError, match="differ in shape"):
        pair_distances(np.zeros((2, 3)), np.zeros((2, 4)))


def test_intervals_contain_the_figure_and_shrink_with_the_root_of_the_pairs() -> None:
    def run(count: int) -> Run:
        rng = np.random.default_rng(count)
        labels = np.arange(count) % 2 == 0
        distances = rng.normal(np.where(labels, 0.4, 0.6), 0.1)
        return Run("net", metrics_at(0.5, distances, labels), distances, labels, (), 0.0, 0, 0)

    widths = {}
    for count in (200, 3200):
        one = run(count)
        for name, text in summary([one], draws=200).items():
            middle, low, high = map(float, re.findall(r"[\d.]+", text))
            assert middle == round(getattr(one.metrics, name.lower().replace(" ", "_")), 3)
            assert low < middle < high
            widths[name, count] = high - low
    for name in ("precision", "recall", "ROC AUC"):
        assert 2.5 < widths[name, 200] / widths[name, 3200] < 6  # about 4
    assert summary([one, one], draws=20) == summary([one], draws=20)
