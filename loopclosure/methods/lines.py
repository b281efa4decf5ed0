"""Step 3 of :mod:`loopclosure.methods.auto`: the statistic, and from where on it tells loops from chance.

The score of a query with a reference is the mean along the best line of pairs through both, of scores whose rows and
columns are standardized: a query that is like everything, and a pass in another season, count as any other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d

from loopclosure.lines.chance import threshold
from loopclosure.lines.course import LENGTHS, VELOCITIES, Course
from loopclosure.lines.trajectories import SequenceSettings, trajectory_costs
from loopclosure.methods.base import BLOCK
from loopclosure.methods.candidates import Candidates
from loopclosure.methods.seqslam import standardize

SPEEDS = (0.5, 2.0, 0.25, 4.0)  # references for a query, tried where neither the ratio of the lengths nor 1 finds any
LEAST_PIECES = 25  # pieces of the length of a line, of queries times of references, that show what chance does
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


class Best(NamedTuple):
    """The best line of each query (n,).

    match   its reference
    score   of the line, -inf without one
    alone   the score of the line through the best single image, -inf without one
    decoy   the best score of a line elsewhere, -inf without one
    other   the reference of that line
    middle  the score of the middle of the line
    chance  what such a short line scores by chance
    """

    match: np.ndarray
    score: np.ndarray
    alone: np.ndarray
    decoy: np.ndarray
    other: np.ndarray
    middle: np.ndarray
    chance: np.ndarray


@dataclass(frozen=True)
class Lines:
    """The best line of each query (Q,), as in :class:`Best`; ``match`` is -1 without one.

    near   whether the place itself is on the line. Where a loop ends, the line through its last place is the best one
           for a while
    loops  which best matches are loops by their lines; none if they are too few to tell
    """

    course: Course
    match: np.ndarray
    score: np.ndarray
    alone: np.ndarray
    decoy: np.ndarray
    other: np.ndarray
    near: np.ndarray
    loops: np.ndarray

    @property
    def above_decoys(self) -> np.ndarray:
        """Which queries (Q,) have a line that is better than every decoy."""
        return self.near & (self.score > self.decoy.max(initial=-np.inf)) & np.isfinite(self.decoy).any()


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


def best_lines(given: Candidates, among: Pool, precision: float) -> Lines | None:
    """Return the search that finds the most loops at this precision, the shortest lines if none finds any.

    One drive is passed at its own speed. Of two traverses one may be a part of the other, at any speed: the ratio of
    their lengths is the speed only if both cover the whole route. None if the drive is too short for lines.
    """
    queries, references = np.count_nonzero(among.decoys.any(axis=1)), among.found.shape[1]
    whole = references / max(1, len(among.found))
    usual = [1.0] if not given.two else [whole] if _same_speed(1.0, whole) else [whole, 1.0]
    unusual = [speed for speed in SPEEDS if given.two and not any(_same_speed(speed, other) for other in usual)]
    chosen, most, all_queries = None, 0, np.count_nonzero(given.there)
    for speeds in (usual, unusual):
        for speed, backwards, length in product(speeds, (False, True), LENGTHS):
            passed = references / speed  # steps
            if queries * passed < LEAST_PIECES * length**2 or min(queries, passed) < length:
                continue
            found = search(given, among, Course(length, speed, backwards), precision)
            count = np.count_nonzero(found.loops)
            if chosen is None or count > most:
                chosen, most = found, count
            if 0 < all_queries == most:
                return chosen
        if most:
            break
    return chosen


def _same_speed(one: float, other: float) -> bool:
    """Return whether lines at one speed are searched at the other too."""
    return VELOCITIES[0] <= one / other <= VELOCITIES[1]


def search(given: Candidates, among: Pool, course: Course, precision: float) -> Lines:
    """Find the best line of each query and its decoy, and which of them are loops at this precision."""
    references = np.arange(among.found.shape[1])
    single = given.single
    if course.backwards:
        among, references, single = among.backwards(), references[::-1], references[::-1][single]
    blocks = [range(first, min(first + BLOCK, len(single))) for first in range(0, len(single), BLOCK)]
    parts = [_search_rows(among, course.sequence, rows, single) for rows in blocks]
    best = Best(*map(np.concatenate, zip(*parts, strict=True)))
    # A line that lies partly past the end of a loop has one wholly inside within half its length.
    whole = maximum_filter1d(np.maximum(best.score, best.chance), 2 * (course.length // 2) + 1)
    near = best.middle >= (best.chance + whole) / 2
    crossed = 2 * course.length + 1 if among.reverse else 0
    chances = np.maximum(0, among.decoys.sum(axis=1) - crossed).sum()
    odds = max(1.0, among.found.sum() / max(1, chances))  # pairs that a line was chosen from, for each of a decoy
    score = np.where(np.isfinite(best.decoy), best.score, -np.inf)  # of what has no decoy nothing is known
    loops = near & (score >= threshold(score, best.decoy, precision, course.length / 2, odds))
    if np.count_nonzero(loops) < course.length:
        loops = np.zeros_like(loops)
    match = np.where(np.isneginf(score), -1, references[best.match])
    return Lines(course, match, score, best.alone, best.decoy, references[best.other], near, loops)


def _search_rows(among: Pool, sequence: SequenceSettings, rows: range, single: np.ndarray) -> Best:
    """Return the best lines of some queries; ``single`` (Q,): the best single image of each query."""
    numbers = np.arange(len(rows))
    scores = _scores(among.distances, among.found, sequence, rows)
    match = scores.argmax(axis=1)
    middle = _scores(among.distances, among.found, replace(sequence, length=MIDDLE), rows)
    chance = [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in middle]
    if among.reverse:
        decoys = _scores(among.distances[:, ::-1], among.decoys[:, ::-1], sequence, rows)[:, ::-1]
        decoys[np.abs(np.arange(decoys.shape[1]) - match[:, None]) <= sequence.length] = -np.inf
    else:
        decoys = _scores(among.distances, among.decoys, sequence, rows)
    alone = scores[numbers, single[rows.start : rows.stop]]
    decoy, other = decoys.max(axis=1), decoys.argmax(axis=1)
    return Best(match, scores.max(axis=1), alone, decoy, other, middle[numbers, match], np.array(chance))


def _scores(distances: np.ndarray, which: np.ndarray, sequence: SequenceSettings, rows: range) -> np.ndarray:
    """Return the scores (n, R) of the best lines through some queries and each reference, -inf where there is none."""
    first, last = max(0, rows.start - sequence.length), min(rows.stop + sequence.length, len(distances))
    window = np.where(which[first:last], distances[first:last], np.nan)
    costs = trajectory_costs(window, sequence, range(rows.start - first, rows.stop - first))
    return np.where(which[rows.start : rows.stop] & np.isfinite(costs), -costs, -np.inf)
