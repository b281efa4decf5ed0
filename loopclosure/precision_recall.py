"""Exact precision and recall of a matrix of scores: one point for each distinct score, no grid of thresholds.

There are two conventions, and their results must not be mixed. Every result here has the name of its convention:

- **all pairs**: every judged pair is a sample (the similarity matrix against its truth, as in the paper);
- **best match of each query**: only the best reference of each query counts, right or wrong; recall is the share of
  found loops among the queries with a loop (FAB-MAP, SeqSLAM and most of the loop-closure literature).

Soft truth marks pairs that are not a mistake but need not be found. Over all pairs, such a pair is ignored. A best
match that is only soft truth is right if the query has a loop, and ignored otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.truth import Truth

ALL_PAIRS = "all pairs"
BEST_MATCH = "best match of each query"


@dataclass(frozen=True)
class PrecisionRecall:
    """A precision-recall curve, from the highest score down; equal scores are one point.

    convention         ALL_PAIRS or BEST_MATCH, or a name for the samples
    thresholds         (n,) the distinct scores, descending; a score >= threshold is called a loop
    precision, recall  (n,)
    positives          number of judged true pairs, or of queries with a loop
    samples            number of judged scores
    truth_description  the rule for the same place, and what was excluded
    """

    convention: str
    thresholds: np.ndarray
    precision: np.ndarray
    recall: np.ndarray
    positives: int
    samples: int
    truth_description: str = ""

    @property
    def average_precision(self) -> float:
        """Sum of (R_n - R_n-1) P_n over the points (not the trapezoid); NaN if there is nothing to find."""
        if not self.positives:
            return float("nan")
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    @property
    def recall_at_full_precision(self) -> float:
        """The largest recall before the first mistake; 0 if the highest score is wrong."""
        if not self.positives:
            return float("nan")
        return float(np.max(self.recall[self.precision >= 1.0], initial=0.0))

    @property
    def best_f1(self) -> float:
        """The largest F1 of any threshold."""
        return float(np.max(self._f1, initial=0.0)) if self.positives else float("nan")

    @property
    def best_f1_threshold(self) -> float:
        """The highest threshold with the largest F1; +inf if no sample is right."""
        f1 = self._f1
        return float(self.thresholds[np.argmax(f1)]) if np.any(f1 > 0) else float("inf")

    @property
    def _f1(self) -> np.ndarray:
        total = self.precision + self.recall
        return np.divide(2 * self.precision * self.recall, total, out=np.zeros_like(total), where=total > 0)


def curve(
    scores: np.ndarray,
    right: np.ndarray,
    positives: int | None = None,
    convention: str = "samples",
    truth_description: str = "",
) -> PrecisionRecall:
    """Build the curve of samples that have a score and are right or wrong.

    scores     (n,); a NaN or -inf is never called a loop
    right      (n,) bool
    positives  number of samples to find; default: the number of True in ``right``
    """
    scores, right = np.asarray(scores).reshape(-1), np.asarray(right, dtype=bool).reshape(-1)
    if len(scores) != len(right):
        raise InputError(f"{len(scores)} scores but {len(right)} answers of right or wrong")
    if positives is None:
        positives = int(np.count_nonzero(right))
    samples = len(scores)
    named = ~np.isnan(scores) & ~np.isneginf(scores)
    scores, right = scores[named], right[named]
    order = np.argsort(-scores, kind="stable")
    scores, right = scores[order], right[order]
    last_of_tie = np.flatnonzero(np.append(scores[1:] != scores[:-1], True)) if len(scores) else np.zeros(0, int)
    true_positives = np.cumsum(right)[last_of_tie]
    called = last_of_tie + 1
    return PrecisionRecall(
        convention=convention,
        thresholds=scores[last_of_tie],
        precision=true_positives / np.maximum(called, 1),
        recall=true_positives / positives if positives else np.zeros(len(last_of_tie)),
        positives=positives,
        samples=samples,
        truth_description=truth_description,
    )


@dataclass(frozen=True)
class BestMatches:
    """The best judged reference of each query.

    reference  (Q,) its number, -1 if the query has no candidate with a score; the first one of equal scores
    score      (Q,) its score, -inf if it has none
    right      (Q,) bool: the match is hard truth, or soft truth and the query has a loop
    ignored    (Q,) bool: the match is soft truth and the query has no loop; neither right nor wrong
    """

    reference: np.ndarray
    score: np.ndarray
    right: np.ndarray
    ignored: np.ndarray


@dataclass(frozen=True)
class JudgedScores:
    """The scores (Q, R) of a method, higher = more similar, and their truth.

    A pair with score NaN is never found, but it counts as missed if it is true. Shared results are computed once.
    """

    scores: np.ndarray
    truth: Truth

    def __post_init__(self) -> None:
        if self.scores.shape != self.truth.hard.shape:
            raise InputError(
                f"the scores are {_by(self.scores.shape)}, the truth is {_by(self.truth.hard.shape)} "
                "(query x reference)"
            )

    def all_pairs_curve(self) -> PrecisionRecall:
        """Return the curve over all pairs."""
        truth = self.truth
        counted = truth.judged & (truth.hard | ~truth.soft)
        return curve(
            self.scores[counted], truth.hard[counted], convention=ALL_PAIRS, truth_description=truth.description
        )

    def best_match_curve(self) -> PrecisionRecall:
        """Return the curve over the best match of each query. A wrong match counts as one mistake."""
        found = self.best_matches
        kept = ~found.ignored
        positives = int(np.count_nonzero(self.truth.queries_with_a_loop))
        return curve(found.score[kept], found.right[kept], positives, BEST_MATCH, self.truth.description)

    @cached_property
    def best_matches(self) -> BestMatches:
        """The best match of each query, and whether it is right."""
        rows = np.arange(len(self._candidates))
        reference = np.argmax(self._candidates, axis=1)
        score = self._candidates[rows, reference]
        none = np.isneginf(score)
        soft = self.truth.soft[rows, reference] & ~none
        loops = self.truth.queries_with_a_loop
        return BestMatches(np.where(none, -1, reference), score, soft & loops, soft & ~loops)

    def recall_at(self, ks: tuple[int, ...]) -> dict[int, float]:
        """Return, for each k, the share of the queries with a loop that have a true reference among their best k.

        Soft truth counts as true. Equal scores are ranked in the order of the references. Queries without a loop are
        left out; NaN if no query has a loop.
        """
        queries = np.flatnonzero(self.truth.queries_with_a_loop)
        if not len(queries):
            return {k: float("nan") for k in ks}
        if min(ks) < 1:
            raise InputError(f"recall at {min(ks)} was asked for; expected 1 or more")
        candidates = self._candidates[queries]
        ranked = np.argsort(-candidates, axis=1, kind="stable")[:, : max(ks)]
        hits = np.take_along_axis(self.truth.soft[queries], ranked, axis=1)
        hits &= ~np.isneginf(np.take_along_axis(candidates, ranked, axis=1))
        found = np.cumsum(hits, axis=1) > 0
        return {k: float(np.mean(found[:, min(k, found.shape[1]) - 1])) for k in ks}

    @cached_property
    def _candidates(self) -> np.ndarray:
        """The scores (Q, R), -inf for NaN and for pairs that are not judged."""
        return np.where(self.truth.judged & ~np.isnan(self.scores), self.scores, -np.inf)


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in shape)
