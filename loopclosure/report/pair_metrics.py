"""How well the distance of two descriptors separates same places from other places: the paper's Table I.

The paper gives a precision without a threshold. Here the threshold is chosen on the training pairs only (best
accuracy), and precision, recall, accuracy, F1 and the area under the ROC curve are those of other pairs (validation
or test). The area needs no threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from loopclosure.errors import InputError


@dataclass(frozen=True)
class PairMetrics:
    """The metrics of one set of pairs at one threshold: a pair is called the same place if its distance < threshold.

    Shares are in 0..1; a share whose denominator is zero (precision when no pair is called the same) is NaN.
    """

    threshold: float
    precision: float
    recall: float
    accuracy: float
    f1: float
    roc_auc: float
    true_positives: int
    false_positives: int
    true_negatives: int
    false_negatives: int

    @property
    def pairs(self) -> int:
        """Return the number of pairs judged."""
        return self.true_positives + self.false_positives + self.true_negatives + self.false_negatives


def pair_distances(features_a: np.ndarray, features_b: np.ndarray) -> np.ndarray:
    """Return the Euclidean distance, which ContrastiveLoss trains, of each row to the same row of ``features_b``.

    features_a, features_b   (N, D); further axes are flattened
    returns                  (N,) float64
    """
    a = np.asarray(features_a, dtype=np.float64)
    b = np.asarray(features_b, dtype=np.float64)
    if a.shape != b.shape or a.ndim < 2:
        raise InputError(f"the two features of a pair differ in shape: {a.shape} and {b.shape}; expected (N, D) twice")
    return np.linalg.norm((a - b).reshape(len(a), -1), axis=1)


def best_threshold(distances: np.ndarray, labels: np.ndarray) -> float:
    """Return the threshold with the best accuracy on these pairs.

    It is halfway between two neighboring distances. Of equally good thresholds the smallest is taken, since a false
    loop harms a map more than a missed one. It is the smallest distance if calling no pair the same place is best.

    distances   (N,); labels   (N,) 1 or True = same place
    """
    distances, same = _checked(distances, labels)
    order = np.argsort(distances, kind="stable")
    ordered, positive = distances[order], same[order]
    # correct[k]: number of pairs judged correctly if exactly the k nearest are called the same place
    correct = np.concatenate([[0], np.cumsum(np.where(positive, 1, -1))]) + np.count_nonzero(~same)
    cuttable = np.concatenate([[True], ordered[1:] > ordered[:-1], [True]])
    best = int(np.argmax(np.where(cuttable, correct, -1)))
    if best == 0:
        return float(ordered[0])
    if best == len(ordered):
        return float(np.nextafter(ordered[-1], np.inf))
    below, above = float(ordered[best - 1]), float(ordered[best])
    middle = below + (above - below) / 2
    return middle if middle > below else above


def roc_auc(distances: np.ndarray, labels: np.ndarray) -> float:
    """Return the probability that a pair of one place is nearer than a pair of two places (ties count half).

    NaN if all pairs are of one kind.
    """
    distances, same = _checked(distances, labels)
    positives = int(np.count_nonzero(same))
    negatives = len(same) - positives
    if positives == 0 or negatives == 0:
        return float("nan")
    rank_sum = float(np.sum(rankdata(-distances)[same]))
    return (rank_sum - positives * (positives + 1) / 2) / (positives * negatives)


def metrics_at(threshold: float, distances: np.ndarray, labels: np.ndarray) -> PairMetrics:
    """Return the metrics of these pairs at a given threshold."""
    distances, same = _checked(distances, labels)
    called = distances < threshold
    tp = int(np.count_nonzero(called & same))
    fp = int(np.count_nonzero(called & ~same))
    fn = int(np.count_nonzero(~called & same))
    tn = int(np.count_nonzero(~called & ~same))
    return PairMetrics(
        threshold=float(threshold),
        precision=_share(tp, tp + fp),
        recall=_share(tp, tp + fn),
        accuracy=_share(tp + tn, len(same)),
        f1=_share(2 * tp, 2 * tp + fp + fn),
        roc_auc=roc_auc(distances, same),
        true_positives=tp,
        false_positives=fp,
        true_negatives=tn,
        false_negatives=fn,
    )


def judge_pairs(
    train_distances: np.ndarray, train_labels: np.ndarray, distances: np.ndarray, labels: np.ndarray
) -> PairMetrics:
    """Choose the threshold on the training pairs and judge the other pairs with it: one row of Table I.

    All four are (N,) or (M,); labels are 1 for same place, 0 for other place.
    """
    return metrics_at(best_threshold(train_distances, train_labels), distances, labels)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def _checked(distances: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances as float64 and labels as bool, both (N,), N > 0."""
    distances = np.asarray(distances, dtype=np.float64).reshape(-1)
    labels = np.asarray(labels).reshape(-1)
    if len(distances) != len(labels):
        raise InputError(f"{len(distances)} distances but {len(labels)} labels; expected one label per pair")
    if len(distances) == 0:
        raise InputError("there are no pairs to judge")
    if not np.all(np.isfinite(distances)):
        count = int(np.count_nonzero(~np.isfinite(distances)))
        raise InputError(f"{count} of {len(distances)} distances are NaN or infinite; did the training diverge?")
    if not np.all(np.isin(labels, (0, 1))):
        odd = labels[~np.isin(labels, (0, 1))][0]
        raise InputError(f"a label is {odd}; expected 1 (same place) or 0 (other place)")
    return distances, labels.astype(bool)
