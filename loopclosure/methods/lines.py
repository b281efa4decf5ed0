"""Step 3 of :mod:`loopclosure.methods.auto`: the statistic, and from where on it tells loops from chance.

The score of a query with a reference is the mean along the best line of pairs through both, of scores whose rows and
columns are standardized: a query that is like everything, and a pass in another season, count as any other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from loopclosure.lines.chance import threshold
from loopclosure.lines.course import VELOCITIES, Course
from loopclosure.lines.trajectories import SequenceSettings, trajectory_costs
from loopclosure.methods.base import BLOCK
from loopclosure.methods.candidates import Candidates
from loopclosure.methods.seqslam import standardize

LENGTHS = (10, 30)  # steps of a line
SPEEDS = (0.5, 2.0, 0.25, 4.0)  # references for a query, tried where neither the ratio of the lengths nor 1 finds any
LEAST_PIECES = 25  # pieces of the length of a line, of queries times of references, that show what chance does
# A shorter line is preferred to a longer one that accepts only this much more: it ends nearer to where a loop ends.
NEARLY = 0.95
MIDDLE = 4  # steps in the middle of a line


@dataclass(frozen=True)
class Pool:
    """The pairs among which lines are searched.

    distances  (Q, R) standardized, NaN for what is no candidate
    found      (Q, R) bool: what a line may match
    decoys     (Q, R) bool: what a decoy may match
    reverse    decoys are lines that pass the references in the other order; False: as the others
    """

    distances: np.ndarray
    found: np.ndarray
    decoys: np.ndarray
    reverse: bool

    def backwards(self) -> Pool:
        """Return the pool with the references in reverse order."""
        return Pool(self.distances[:, ::-1], self.found[:, ::-1], self.decoys[:, ::-1], self.reverse)


@dataclass(frozen=True)
class Best:
    """The best line of each query (Q,).

    match    its reference, -1 without one
    targets  its score, -inf without one
    alone    the score of the line through the best single image, -inf without one
    decoys   the best score of a line elsewhere, -inf without one
    other    the reference of that line
    middle   the score of the middle of the line
    chance   what such a short line scores by chance
    """

    match: np.ndarray
    targets: np.ndarray
    alone: np.ndarray
    decoys: np.ndarray
    other: np.ndarray
    middle: np.ndarray
    chance: np.ndarray

    @classmethod
    def joined(cls, parts: list[Best]) -> Best:
        """Return the lines of consecutive blocks of queries as one."""
        return cls(*(np.concatenate([getattr(part, of.name) for part in parts]) for of in fields(cls)))


@dataclass(frozen=True)
class Lines:
    """What a search found.

    near  whether the place itself is on the line (Q,). Where a loop ends, the line through its last place is the best
          one for a while
    odds  from how many pairs a line was chosen, as a multiple of those that its decoy was chosen from
    """

    course: Course
    best: Best
    near: np.ndarray
    odds: float

    def accepted(self, precision: float) -> np.ndarray:
        """Return which best matches (Q,) are loops by their lines; none if they are too few to tell."""
        least = threshold(self.best.targets, self.best.decoys, precision, self.course.length / 2, self.odds)
        accepted = self.near & (self.best.targets >= least)
        return accepted if np.count_nonzero(accepted) >= self.course.length else np.zeros_like(accepted)

    @property
    def above_decoys(self) -> np.ndarray:
        """Which queries (Q,) have a line that is better than every decoy."""
        decoys = self.best.decoys
        return self.near & (self.best.targets > decoys.max(initial=-np.inf)) & np.isfinite(decoys).any()


def pool(given: Candidates, elsewhere: np.ndarray) -> Pool:
    """Return what lines are searched among; ``elsewhere`` (Q, R) are pairs that surely show different places."""
    if given.far is None:
        return Pool(_standardized(given, elsewhere), elsewhere, elsewhere, True)
    return Pool(_standardized(given, elsewhere | given.far), elsewhere, given.far, False)


def _standardized(given: Candidates, which: np.ndarray) -> np.ndarray:
    """Return the distances of some pairs (Q, R), standardized; of one drive, each frame by all others, older or not."""
    distances = np.where(which, -given.scores, np.nan)
    if not given.two:
        distances = np.where(which.T, distances.T, distances)
    return standardize(distances, usual=True)


def courses(among: Pool, two: bool) -> Iterator[list[Course]]:
    """Yield groups of courses, those of a group the shortest first: one speed and direction.

    One drive is passed at its own speed. Of two traverses one may be a part of the other, at any speed: the ratio of
    their lengths is the speed only if both cover the whole route.
    """
    queries, references = np.count_nonzero(among.decoys.any(axis=1)), among.found.shape[1]
    whole = references / max(1, len(among.found))
    tried = [whole] if two else []
    for speed in [*tried, 1.0, *(SPEEDS if two else ())]:
        if speed != whole and any(VELOCITIES[0] <= speed / other <= VELOCITIES[1] for other in tried):
            continue  # searched already
        tried.append(speed)
        for backwards in (False, True):
            group = [
                Course(length, speed, backwards)
                for length in LENGTHS
                if queries * references / speed >= LEAST_PIECES * length**2
                and min(queries, references / speed) >= length
            ]
            if group:
                yield group


def search(given: Candidates, among: Pool, course: Course) -> Lines:
    """Find the best line of each query, and its decoy."""
    single = given.single
    if course.backwards:
        among, single = among.backwards(), among.found.shape[1] - 1 - single
    blocks = [range(first, min(first + BLOCK, len(single))) for first in range(0, len(single), BLOCK)]
    best = Best.joined([_search_rows(among, course.sequence, rows, single) for rows in blocks])
    # A line that lies partly past the end of a loop has one wholly inside within half its length.
    whole = maximum_filter1d(np.maximum(best.targets, best.chance), 2 * (course.length // 2) + 1)
    near = best.middle >= (best.chance + whole) / 2
    crossed = 2 * course.length + 1 if among.reverse else 0
    chances = np.maximum(0, among.decoys.sum(axis=1) - crossed).sum()
    odds = max(1.0, among.found.sum() / max(1, chances))
    targets = np.where(np.isfinite(best.decoys), best.targets, -np.inf)  # of what has no decoy nothing is known
    match, other = best.match, best.other
    if course.backwards:
        match, other = (among.found.shape[1] - 1 - of for of in (match, other))
    match = np.where(np.isneginf(targets), -1, match)
    return Lines(course, replace(best, targets=targets, match=match, other=other), near, odds)


def _search_rows(among: Pool, sequence: SequenceSettings, rows: range, single: np.ndarray) -> Best:
    """Return the best lines of some queries; ``single`` (Q,): the best single image of each query."""
    reach, numbers = sequence.length, np.arange(len(rows))
    own = _scores(among.distances, among.found, sequence, rows)
    match = own.argmax(axis=1)
    middle = _scores(among.distances, among.found, replace(sequence, length=MIDDLE), rows)
    chance = [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in middle]
    if among.reverse:
        decoys = _scores(among.distances[:, ::-1], among.decoys[:, ::-1], sequence, rows)[:, ::-1]
        decoys[np.abs(np.arange(decoys.shape[1]) - match[:, None]) <= reach] = -np.inf
    else:
        decoys = _scores(among.distances, among.decoys, sequence, rows)
    return Best(
        match,
        own.max(axis=1),
        own[numbers, single[rows.start : rows.stop]],
        decoys.max(axis=1),
        decoys.argmax(axis=1),
        middle[numbers, match],
        np.array(chance),
    )


def _scores(distances: np.ndarray, which: np.ndarray, sequence: SequenceSettings, rows: range) -> np.ndarray:
    """Return the scores (n, R) of the best lines through some queries and each reference, -inf where there is none."""
    first, last = max(0, rows.start - sequence.length), min(rows.stop + sequence.length, len(distances))
    window = np.where(which[first:last], distances[first:last], np.nan)
    costs = trajectory_costs(window, sequence, range(rows.start - first, rows.stop - first))
    return np.where(which[rows.start : rows.stop] & np.isfinite(costs), -costs, -np.inf)


def best_lines(given: Candidates, among: Pool, precision: float) -> Lines | None:
    """Return the search that finds the most loops at this precision, the shortest lines if none finds any.

    None if the drive is too short for lines.
    """
    chosen, most, there = None, 0, np.count_nonzero(given.there)
    for group in courses(among, given.two):
        if group[0].speed in SPEEDS and most:
            break
        for course in group:
            if most and there * NEARLY <= most:
                return chosen  # no other can find more
            found = search(given, among, course)
            count = np.count_nonzero(found.accepted(precision))
            if chosen is None or count * NEARLY > most:
                chosen, most = found, count
    return chosen
