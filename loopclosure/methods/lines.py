"""Step 3 of :mod:`loopclosure.methods.auto`: the statistic, and from where on it tells loops from chance.

The score of a query with a reference is the mean along the best line of pairs through both, of scores whose rows and
columns are standardized: a query that is like everything, and a pass in another season, count as any other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from loopclosure.methods.base import BLOCK
from loopclosure.methods.candidates import Candidates
from loopclosure.methods.seqslam import SequenceSettings, standardize, trajectory_costs

LENGTHS = (10, 30)  # steps of a line
VELOCITIES = (0.8, 1.2, 0.1)  # least, greatest and step, as shares of the ratio of the lengths of the traverses
LEAST_LENGTHS = 5  # lengths of a line that a drive must have, to show what chance does
TAIL = 0.1  # share of the decoys that the tail is fitted to, and at least so many:
LEAST_TAIL = 5
LEAST_ACCEPTED = 10  # fewer matches than this cannot be told from one chance line
# A shorter line is preferred to a longer one that accepts only this much more: it ends nearer to where a loop ends.
NEARLY = 0.95
REACH = 4  # queries before and after one that may fit its match better
MIDDLE = 4  # steps in the middle of a line


@dataclass(frozen=True)
class Pool:
    """The pairs among which lines are searched.

    distances  (Q, R) standardized, NaN for what is no candidate
    found      (Q, R) bool: what a line may match
    decoys     (Q, R) bool: what a decoy may match
    backwards  decoys are lines with the references in reverse order; False: as the others
    """

    distances: np.ndarray
    found: np.ndarray
    decoys: np.ndarray
    backwards: bool


@dataclass(frozen=True)
class Lines:
    """What a search found, of each query (Q,).

    sequence  how lines run
    match     its best reference, -1 without one
    targets   that score, -inf without one
    alone     the score of the line through the best single image, -inf without one
    decoys    the best score of a line elsewhere, -inf without one
    near      whether the place itself is on the line. Where a loop ends, the line through its last place is the best
              one for a while
    odds      from how many pairs a line was chosen, as a multiple of those that its decoy was chosen from
    """

    sequence: SequenceSettings
    match: np.ndarray
    targets: np.ndarray
    alone: np.ndarray
    decoys: np.ndarray
    near: np.ndarray
    odds: float

    def accepted(self, precision: float) -> np.ndarray:
        """Return which best matches (Q,) are loops by their lines; none if they are too few to tell."""
        together = max(REACH, self.sequence.length / 2)
        accepted = self.near & (self.targets >= threshold(self.targets, self.decoys, precision, together, self.odds))
        least = max(LEAST_ACCEPTED, self.sequence.length)
        return accepted if np.count_nonzero(accepted) >= least else np.zeros_like(accepted)

    @property
    def above_decoys(self) -> np.ndarray:
        """Which queries (Q,) have a line that is better than every decoy."""
        return self.near & (self.targets > self.decoys.max(initial=-np.inf)) & np.isfinite(self.decoys).any()

    def __str__(self) -> str:
        s = self.sequence
        return f"sequences of {s.length} frames, at {s.slowest:.3g} to {s.fastest:.3g} times the speed"


def threshold(
    targets: np.ndarray, decoys: np.ndarray, precision: float, together: float = 1.0, odds: float = 1.0
) -> float:
    """Return the least score t such that of the targets >= t the share of wrong ones is at most 1 - ``precision``.

    targets, decoys  (Q,) best scores of each query, -inf without one; a wrong target is distributed as a decoy
    together         how many neighboring decoys tell no more than one
    odds             chances of a wrong target for each of a decoy

    Above a level the decoys are taken to fall exponentially (the peaks over a threshold of extreme-value theory), with
    a scale that is widened by the uncertainty of the few independent decoys there are.
    """
    decoys = np.sort(decoys[np.isfinite(decoys)])[::-1]
    scores = np.sort(targets[np.isfinite(targets)])[::-1]
    tail = max(LEAST_TAIL, int(TAIL * len(decoys)))
    if len(decoys) < 4 * LEAST_TAIL:
        return np.inf
    level = decoys[tail]
    scale = (decoys[:tail] - level).mean() * (1 + np.sqrt(together / tail)) + 1e-12
    wrong = np.where(scores > level, odds * tail / len(decoys) * np.exp(-np.maximum(scores - level, 0) / scale), 1.0)
    good = np.flatnonzero(len(scores) * wrong <= (1 - precision) * np.arange(1, len(scores) + 1))
    return float(scores[good[-1]]) if len(good) else np.inf


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


def sequences(among: Pool, two: bool) -> Iterator[SequenceSettings]:
    """Yield how lines may run, the shortest first; ``two`` traverses, or one drive with itself."""
    queries, references = among.found.shape
    ratio = references / queries if two else 1.0
    slowest, fastest, step = (ratio * velocity for velocity in VELOCITIES)
    judged = min(np.count_nonzero(among.decoys.any(axis=1)), references / ratio)
    for length in LENGTHS:
        if judged >= LEAST_LENGTHS * length:
            yield SequenceSettings(length, slowest, fastest, step, contrast=0)


def search(given: Candidates, among: Pool, sequence: SequenceSettings) -> Lines:
    """Find the best line of each query, and its decoy."""
    count, width = among.found.shape
    blocks = [range(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]
    parts = [_search_rows(given, among, sequence, rows) for rows in blocks]
    match, targets, alone, decoys, owner, middle, chance, spread = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    # A line that lies partly past the end of a loop has one wholly inside within half its length.
    whole = maximum_filter1d(np.maximum(targets, chance), 2 * (sequence.length // 2) + 1)
    near = (middle >= (chance + whole) / 2) & (np.abs(owner) <= max(REACH, count / width if given.two else 1))
    crossed = 2 * sequence.length + 1 if among.backwards else 0
    chances = np.maximum(0, among.decoys.sum(axis=1) - crossed).sum()
    odds = max(1.0, among.found.sum() / max(1, chances))
    # Where chance lines differ more than usual, as of frames in one season, so much more is needed.
    usual = np.median(spread[spread > 0]) if np.any(spread > 0) else 1.0
    targets, alone = (scores / np.maximum(1.0, spread / usual) for scores in (targets, alone))
    targets = np.where(np.isfinite(decoys), targets, -np.inf)  # of what has no decoy nothing is known
    return Lines(sequence, np.where(np.isneginf(targets), -1, match), targets, alone, decoys, near, odds)


def _search_rows(given: Candidates, among: Pool, sequence: SequenceSettings, rows: range) -> tuple[np.ndarray, ...]:
    """Return of some queries (n,): match, targets, alone and decoys of :class:`Lines`, and what tells where loops end.

    These are how many queries away that is which fits the match best, the score of the middle of the line, and what
    such a short line scores by chance.
    """
    reach, numbers = sequence.length, np.arange(len(rows))
    around = range(max(0, rows.start - reach), min(rows.stop + reach, len(among.found)))
    found = _scores(among.distances, among.found, sequence, around)
    own = found[rows.start - around.start :][: len(rows)]
    match, targets = own.argmax(axis=1), own.max(axis=1)
    owner = np.array(
        [_owner(found[:, column], row - around.start, reach) for row, column in zip(rows, match, strict=True)]
    )
    middle = _scores(among.distances, among.found, replace(sequence, length=MIDDLE), rows)
    chance = np.array([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in middle])
    if among.backwards:
        decoys = _scores(among.distances[:, ::-1], among.decoys[:, ::-1], sequence, rows)[:, ::-1]
    else:
        decoys = _scores(among.distances, among.decoys, sequence, rows)
    spread = np.array([row[np.isfinite(row)].std() if np.isfinite(row).any() else 0.0 for row in decoys])
    if among.backwards:
        decoys[np.abs(np.arange(decoys.shape[1]) - match[:, None]) <= reach] = -np.inf
    alone = own[numbers, given.single[rows.start : rows.stop]]
    return match, targets, alone, decoys.max(axis=1), owner, middle[numbers, match], chance, spread


def _scores(distances: np.ndarray, which: np.ndarray, sequence: SequenceSettings, rows: range) -> np.ndarray:
    """Return the scores (n, R) of the best lines through some queries and each reference, -inf where there is none."""
    first, last = max(0, rows.start - sequence.length), min(rows.stop + sequence.length, len(distances))
    window = np.where(which[first:last], distances[first:last], np.nan)
    costs = trajectory_costs(window, sequence, range(rows.start - first, rows.stop - first))
    return np.where(which[rows.start : rows.stop] & np.isfinite(costs), -costs, -np.inf)


def _owner(column: np.ndarray, row: int, reach: int) -> int:
    """Return how far away from ``row`` the greatest of the scores (n,) within ``reach`` is."""
    first = max(0, row - reach)
    around = column[first : row + reach + 1]
    return 0 if column[row] == around.max() else first + int(around.argmax()) - row


def best_lines(given: Candidates, among: Pool, precision: float) -> Lines | None:
    """Return the search that finds the most loops at this precision, the shortest lines if none finds any.

    None if the drive is too short for lines.
    """
    chosen, most = None, 0
    for sequence in sequences(among, given.two):
        if most and np.count_nonzero(given.there) * NEARLY <= most:
            break  # no other can find more
        found = search(given, among, sequence)
        count = np.count_nonzero(found.accepted(precision))
        if chosen is None or count * NEARLY > most:
            chosen, most = found, count
    return chosen
