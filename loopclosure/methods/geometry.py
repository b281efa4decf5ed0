"""Step 4 of :mod:`loopclosure.methods.auto`: finds the matches that show the same points.

The number of inliers that chance explains is computed for each pair from the number of matches and the image sizes
(:mod:`loopclosure.detector.verification`). It does not depend on what other pairs of images have in common.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from loopclosure.detector.verification import LEAST_MATCHES, Agreement, Between, GeometricCheck
from loopclosure.methods.candidates import Candidates
from loopclosure.methods.lines import Lines
from loopclosure.progress import Progress

SAMPLE = 40  # pairs of different places, and of one visit, from which it is found what these have in common

Agree = Callable[[int, int], Agreement]


@dataclass
class Matches:
    """The match of each query, as arrays (Q,).

    match     the best reference, -1 without one
    score     of the match, or of its line if lines are used; -inf without a match
    line      whether its line makes it a loop
    inliers   of the match, 0 if chance explains them, -1 if it was not verified
    evidence  its inliers divided by the number needed
    whole     whether most of its points that match agree, see :attr:`Agreement.whole`
    few       whether it had too few points to be verified or rejected
    """

    match: np.ndarray
    score: np.ndarray
    line: np.ndarray
    inliers: np.ndarray
    evidence: np.ndarray
    whole: np.ndarray
    few: np.ndarray

    @classmethod
    def of(cls, given: Candidates, lines: Lines | None) -> Matches:
        """Return the match of each query by its line, or, where lines tell nothing, its best candidate."""
        count = len(given.queries)
        match, score, line = np.where(given.there, given.single, -1), given.best, np.zeros(count, bool)
        if lines is not None and lines.loops.any():
            match, score, line = np.where(lines.match < 0, match, lines.match), lines.score, lines.loops
        whole, few = np.zeros((2, count), bool)
        return cls(match, score, line, np.full(count, -1), np.zeros(count), whole, few)

    @property
    def there(self) -> np.ndarray:
        """Whether each query has a match."""
        return self.match >= 0

    @property
    def tried(self) -> np.ndarray:
        """Whether each match was verified."""
        return self.inliers >= 0

    @property
    def verified(self) -> np.ndarray:
        """Whether each match has more points that agree than chance explains."""
        return self.evidence >= 1

    @property
    def by_lines(self) -> bool:
        """Whether lines tell loops from other places in this drive, so that matches are theirs."""
        return bool(self.line.any())


@dataclass(frozen=True)
class Geometry:
    """Verification of frames, by their number in the whole drive.

    check   the geometric check
    agree   a function: how many points of a query and a reference agree
    unlike  how many points of each of some dissimilar pairs (n,) agree, 0 if chance explains them: the stripes of a
            curb repeat, and a desk is in all images of it
    """

    check: GeometricCheck
    agree: Agree
    unlike: np.ndarray

    @classmethod
    def of(cls, given: Candidates, check: GeometricCheck, agree: Agree, rows: np.ndarray) -> Geometry:
        """Examine dissimilar pairs, and ignore parts that are the same in many images: a clock, the hood of the car.

        rows  (Q,) bool: the queries to verify
        """
        unlike = _unlike(given, rows)
        if isinstance(agree, Between) and unlike:
            agree = agree.without_fixed(unlike + _newest(given, rows))
        return cls(check, agree, np.array([check.enough(agree(*pair)) for pair in unlike], int))

    @property
    def hidden(self) -> float:
        """The share of the images that is ignored."""
        return self.agree.hidden if isinstance(self.agree, Between) else 0.0

    def evidence(self, agreement: Agreement) -> float:
        """Return the inliers of an agreement divided by the number needed: against chance and dissimilar pairs."""
        return self.check.evidence(agreement, float(self.unlike.mean()) if len(self.unlike) else 0.0)

    def among_queries(self, two: bool) -> Agree | None:
        """Return a function: how many points of two queries agree; None if that cannot be told of ``two`` traverses."""
        if isinstance(self.agree, Between):
            return replace(self.agree, references=self.agree.queries)
        return None if two else self.agree


def _sample(queries: np.ndarray) -> np.ndarray:
    """Return at most ``SAMPLE`` of the queries (Q,) bool, evenly spread, by number."""
    numbers = np.flatnonzero(queries)
    return numbers[np.unique(np.linspace(0, len(numbers) - 1, SAMPLE if len(numbers) else 0).round().astype(int))]


def _unlike(given: Candidates, rows: np.ndarray) -> list[tuple[int, int]]:
    """Return the numbers of pairs that are dissimilar by their scores."""
    pairs = []
    for query in _sample(rows & (np.count_nonzero(given.allowed, axis=1) >= 8)).tolist():
        candidates = np.flatnonzero(given.allowed[query])
        order = candidates[np.argsort(given.scores[query, candidates], kind="stable")]
        # A pair from the least similar quarter of the query, of another rank for each query.
        pairs.append(given.numbers(query, int(order[query % (len(order) // 4)])))
    return pairs


def _newest(given: Candidates, rows: np.ndarray) -> list[tuple[int, int]]:
    """Return queries of one drive, each with its newest candidate: most likely another place in the same light."""
    queries = [] if given.two else _sample(given.there & rows).tolist()
    return [given.numbers(query, int(np.flatnonzero(given.allowed[query])[-1])) for query in queries]


def verify(
    given: Candidates, lines: Lines | None, found: Matches, rows: np.ndarray, geometry: Geometry, progress: Progress
) -> Matches:
    """Verify the match of each query, or else its best single image or line, which then becomes its match.

    rows  (Q,) bool: the queries to verify
    """
    matches, second, score = deepcopy(found), given.single, given.best
    if lines is not None and matches.by_lines:
        score = lines.alone
    elif lines is not None:
        second = np.where(lines.match >= 0, lines.match, second)
        score = given.scores[np.arange(len(second)), second]
    there = np.flatnonzero(matches.there & rows).tolist()
    for query in progress(there, "verification", len(there)):
        tried = [(int(matches.match[query]), matches.score[query])]
        # The lamps of a tunnel repeat: one verified image does not overrule an accepted sequence.
        if not matches.line[query] and second[query] != matches.match[query]:
            tried.append((int(second[query]), score[query]))
        for reference, of_reference in tried:
            agreement = geometry.agree(*given.numbers(query, reference))
            matches.inliers[query] = geometry.check.enough(agreement)
            matches.evidence[query] = geometry.evidence(agreement)
            matches.whole[query] = agreement.whole
            matches.few[query] = agreement.matches < LEAST_MATCHES
            if matches.inliers[query]:
                matches.match[query], matches.score[query] = reference, of_reference
                break
    return matches
