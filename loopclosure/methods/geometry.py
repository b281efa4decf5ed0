"""Step 4 of :mod:`loopclosure.methods.auto`: finds the matches that show the same points.

The number of inliers that chance explains is computed for each pair from the number of matches and the image sizes
(:mod:`loopclosure.detector.verification`). It does not depend on what other pairs of images have in common.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from loopclosure.detector.verification import LEAST_MATCHES, Agreement, Between, GeometricCheck
from loopclosure.methods.candidates import Candidates
from loopclosure.methods.lines import Lines
from loopclosure.progress import Progress

SAMPLE = 40  # pairs from which fixed parts of the images, and the points of unlike pairs, are found

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
    def of(cls, given: Candidates, lines: Lines | None, precision: float) -> Matches:
        """Return the match of each query by its line, or, where lines tell nothing, its best candidate."""
        count = len(given.queries)
        match, score, line = np.where(given.there, given.single, -1), given.best, np.zeros(count, bool)
        if lines is not None and np.any(accepted := lines.accepted(precision)):
            there = lines.best.match >= 0
            match = np.where(there, lines.best.match, match)
            score, line = np.where(there, lines.best.targets, -np.inf), accepted
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
    common  how many dissimilar pairs agree: the stripes of a curb repeat, and a desk is in all images of it
    points  the mean number of their points that agree, of those pairs that do not agree 0
    tried   the number of dissimilar pairs that were examined
    hidden  the share of the images that is ignored
    """

    check: GeometricCheck
    agree: Agree
    common: int = 0
    points: float = 0.0
    tried: int = 0
    hidden: float = 0.0

    @classmethod
    def of(cls, given: Candidates, check: GeometricCheck, agree: Agree, rows: np.ndarray) -> Geometry:
        """Examine dissimilar pairs, and ignore parts that are the same in many images: a clock, the hood of the car.

        rows  (Q,) bool: the queries to verify
        """
        unlike = _numbers(given, _unlike(given, rows))
        hidden = 0.0
        if isinstance(agree, Between) and unlike:
            agree = agree.without_fixed(unlike + _numbers(given, _left(given, rows)))
            hidden = agree.hidden
        inliers = np.array([check.enough(agree(query, reference)) for query, reference in unlike])
        points = float(np.mean(inliers)) if len(inliers) else 0.0
        return cls(check, agree, int(np.count_nonzero(inliers)), points, len(inliers), hidden)

    def evidence(self, agreement: Agreement) -> float:
        """Return the inliers of an agreement divided by the number needed: against chance and dissimilar pairs."""
        return self.check.evidence(agreement, self.points)

    def among_queries(self, two: bool) -> Agree | None:
        """Return a function: how many points of two queries agree; None if that cannot be told of ``two`` traverses."""
        if isinstance(self.agree, Between):
            return replace(self.agree, references=self.agree.queries)
        return None if two else self.agree


def _sample(numbers: np.ndarray) -> np.ndarray:
    """Return at most ``SAMPLE`` of the numbers, evenly spread."""
    if not len(numbers):
        return numbers
    return numbers[np.unique(np.linspace(0, len(numbers) - 1, SAMPLE).round().astype(int))]


def _numbers(given: Candidates, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return pairs (row, column) by their numbers in the whole drive."""
    return [(int(given.queries[query]), int(given.references[reference])) for query, reference in pairs]


def _unlike(given: Candidates, rows: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs that are dissimilar by their scores."""
    known, pairs = given.known(), []
    for query in _sample(np.flatnonzero(rows & (np.count_nonzero(np.isfinite(known), axis=1) >= 8))):
        order = np.argsort(known[query], kind="stable")
        candidates = order[np.isfinite(known[query, order])]
        # A pair from the least similar quarter of the query, of another rank for each query.
        pairs.append((int(query), int(candidates[int(query) % max(1, len(candidates) // 4)])))
    return pairs


def _left(given: Candidates, rows: np.ndarray) -> list[tuple[int, int]]:
    """Return queries of one drive, each with its newest candidate: most likely another place in the same light."""
    if given.two:
        return []
    queries = _sample(np.flatnonzero(given.there & rows))
    return [(int(query), int(np.flatnonzero(given.allowed[query])[-1])) for query in queries]


def verify(
    given: Candidates, lines: Lines | None, matches: Matches, rows: np.ndarray, geometry: Geometry, progress: Progress
) -> None:
    """Verify the match of each query, or else its best single image or line, which then becomes its match.

    rows  (Q,) bool: the queries to verify
    """
    there, instead, alone = np.flatnonzero(matches.there & rows), given.single, None
    if lines is not None and matches.by_lines:
        alone = lines.best.alone
    elif lines is not None:
        instead = np.where(lines.best.match >= 0, lines.best.match, instead)
    for query in progress(there, "verification", len(there)):
        # The lamps of a tunnel repeat: one verified image does not overrule an accepted sequence.
        other = matches.match if matches.line[query] else instead
        for reference in dict.fromkeys((int(matches.match[query]), int(other[query]))):
            agreement = geometry.agree(int(given.queries[query]), int(given.references[reference]))
            matches.inliers[query] = geometry.check.enough(agreement)
            matches.evidence[query] = geometry.evidence(agreement)
            matches.whole[query] = agreement.whole
            matches.few[query] = agreement.matches < LEAST_MATCHES
            if matches.inliers[query]:
                if reference != matches.match[query]:
                    matches.match[query] = reference
                    matches.score[query] = given.scores[query, reference] if alone is None else alone[query]
                break
