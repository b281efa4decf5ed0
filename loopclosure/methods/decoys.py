"""Which matches are loops, found by the scores alone: sequences against the same sequences backwards.

A match that repeats a stretch of road lies on a line of similar pairs, in the direction in which time runs. Searched
for with the references in reverse order, the same matrix has lines too, as similar as different places get on this
camera, but (nearly) none of the same place. So the best reverse line of each query is a decoy: what its best forward
line would score if it had no loop. How decoys are distributed says how many of the forward lines above a score are
wrong, without truth: target-decoy competition as in Elias and Gygi, "Target-decoy search strategy" (Nature Methods
2007), with an exponential tail (the peaks over a threshold of extreme-value theory), whose scale is widened by the
uncertainty of the few independent decoys there are.

A camera that turns back and forth over the same things makes decoys as good as loops. Then little is accepted. Where
odometry tells which frames are far apart, the best of these is the decoy, and single images can be told from chance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from loopclosure.methods.base import BLOCK
from loopclosure.methods.candidates import Candidates
from loopclosure.methods.seqslam import SequenceSettings, standardize, trajectory_costs

LENGTHS = (10, 30, 60)
# Velocities, as shares of the ratio of the lengths: even motion, and stops and spurts.
EVEN, UNEVEN = (0.8, 1.2, 0.1), (0.5, 2.0, 0.1875)
TAIL = 0.1  # share of the decoys that the tail is fitted to, and at least so many:
LEAST_TAIL = 5
# Fewer matches than this cannot be told apart from one chance sequence.
LEAST_ACCEPTED = 10
# A shorter sequence is preferred to a longer one that accepts only this much more: it ends nearer to where a loop ends.
NEARLY = 0.95
# Neighbors of a query, so many before and after, may fit its match better.
REACH = 4
MIDDLE = 4  # steps of a line


@dataclass(frozen=True)
class Setting:
    """How sequences are searched, None: images one by one; ``standardized``: rows and columns of the scores first."""

    sequence: SequenceSettings | None
    standardized: bool = False

    @property
    def length(self) -> int:
        """Frames in a sequence, 0 without one."""
        return self.sequence.length if self.sequence else 0

    def __str__(self) -> str:
        s = self.sequence
        if s is None:
            return "single images"
        scaled = ", rows and columns standardized" if self.standardized else ""
        return f"sequences of {s.length} frames, at {s.slowest:.3g} to {s.fastest:.3g} times the speed{scaled}"


@dataclass(frozen=True)
class Lines:
    """What a search found.

    match    (Q,) each query's best reference, -1 without one
    targets  (Q,) its score, -inf without one
    alone    (Q,) that of the line through the best single image, -inf without one
    decoys   (Q,) the best score of a reverse line, or of frames far apart in odometry, -inf without one
    near     (Q,) bool: of the queries just before and after, no distant one fits the match better, and the middle of
             the line is nearer to its mean than to chance. Where a loop ends, the line through its last place is the
             best one for a while
    """

    setting: Setting
    match: np.ndarray
    targets: np.ndarray
    alone: np.ndarray
    decoys: np.ndarray
    near: np.ndarray

    def threshold(self, precision: float) -> float:
        """Return the least score above which at least this share of the best matches is right; inf if none is."""
        return threshold(self.targets, self.decoys, precision, max(REACH, self.setting.length / 2))

    def accepted(self, precision: float) -> np.ndarray:
        """Return which best matches (Q,) are loops; none if they are too few to tell."""
        accepted = (self.targets >= self.threshold(precision)) & self.near
        least = max(LEAST_ACCEPTED, self.setting.length)
        return accepted if np.count_nonzero(accepted) >= least else np.zeros_like(accepted)


@dataclass
class Matches:
    """The match of each query, as one step after the other sees it: (Q,) arrays.

    match     the best reference, -1 without one
    score     of the match, that of a line where lines are used; -inf without one
    accepted  whether lines, or the score, make it a loop
    inliers   of the match, 0 if chance explains them, -1 where it was not verified
    evidence  its inliers as a share of those that rule out chance
    few       whether it had too few points to be verified or rejected
    """

    match: np.ndarray
    score: np.ndarray
    accepted: np.ndarray
    inliers: np.ndarray
    evidence: np.ndarray
    few: np.ndarray

    @classmethod
    def of(cls, given: Candidates, lines: Lines | None, precision: float) -> Matches:
        """Return the matches that the lines find, or else each query's best candidate."""
        if lines is not None:
            match, score, accepted = lines.match.copy(), lines.targets, lines.accepted(precision)
        else:
            known = given.known()
            score = known.max(axis=1)
            match = np.where(np.isfinite(score), known.argmax(axis=1), -1)
            accepted = np.zeros(len(match), bool)
        return cls(match, score, accepted, np.full(len(match), -1), np.zeros(len(match)), np.zeros(len(match), bool))

    @property
    def there(self) -> np.ndarray:
        """Which queries have a match."""
        return self.match >= 0


def threshold(targets: np.ndarray, decoys: np.ndarray, precision: float, together: float = 1.0) -> float:
    """Return the least score t such that of the targets >= t the share of wrong ones is at most 1 - ``precision``.

    targets, decoys  (Q,) best scores of each query, -inf without one; a wrong target is distributed as a decoy
    together         how many neighboring decoys tell no more than one
    """
    decoys = np.sort(decoys[np.isfinite(decoys)])[::-1]
    scores = np.sort(targets[np.isfinite(targets)])[::-1]
    tail = max(LEAST_TAIL, int(TAIL * len(decoys)))
    if len(decoys) < 4 * LEAST_TAIL:
        return np.inf
    level = decoys[tail]
    scale = (decoys[:tail] - level).mean() * (1 + np.sqrt(together / tail)) + 1e-12
    wrong = np.where(scores > level, tail / len(decoys) * np.exp(-np.maximum(scores - level, 0) / scale), 1.0)
    good = np.flatnonzero(len(scores) * wrong <= (1 - precision) * np.arange(1, len(scores) + 1))
    return float(scores[good[-1]]) if len(good) else np.inf


def settings(queries: int, references: int, two: bool) -> Iterator[Setting]:
    """Yield the settings worth trying, the simplest first; ``two`` traverses, or one sequence with itself."""
    ratio = references / queries if two else 1.0
    for length in LENGTHS:
        if 2.5 * length > min(queries, references / ratio):
            continue
        for slowest, fastest, step in (EVEN, UNEVEN):
            sequence = SequenceSettings(length, slowest * ratio, fastest * ratio, step * ratio, contrast=0)
            for standardized in (False, True)[: 1 + two]:
                yield Setting(sequence, standardized)


def search(given: Candidates, setting: Setting, shared: dict[str, np.ndarray]) -> Lines:
    """Search for lines through candidates; decoys are the lines backwards, or pairs known to be different.

    ``shared`` is what searches of the same candidates have in common.
    """
    (count, width), sequence, reach = given.scores.shape, setting.sequence, setting.length
    if setting.standardized and "scaled" not in shared:
        shared["scaled"] = standardize(_distances(given.scores, given.allowed))
    middle = None if sequence is None else replace(sequence, length=MIDDLE)
    chance = shared.setdefault(f"{middle} {setting.standardized}", np.full(count, np.nan))
    match, targets, decoys, fits = np.zeros(count, int), np.empty(count), np.empty(count), np.empty(count)
    alone, beside = np.empty(count), np.full((count, 2 * reach + 1), -np.inf, np.float32)
    last = np.empty((0, width), np.float32)
    for first in range(0, count, BLOCK):
        here, around = slice(first, min(first + BLOCK, count)), slice(max(0, first - reach), first + BLOCK + reach)
        inner, allowed = range(first - around.start, here.stop - around.start), given.allowed[here]
        if setting.standardized:
            block = shared["scaled"][around]
        else:
            block = _distances(given.scores[around], given.allowed[around])
        found = np.where(allowed, -_along(block, sequence, inner), np.nan)
        if given.different is None:
            reverse = np.where(allowed, -_along(block[:, ::-1], sequence, inner)[:, ::-1], np.nan)
        else:
            known = _along(_distances(given.scores[around], given.different[around]), sequence, inner)
            reverse = np.where(given.different[here], -known, np.nan)
        np.copyto(found, -np.inf, where=np.isnan(found))
        numbers = np.arange(len(found))
        match[here], targets[here] = found.argmax(axis=1), found.max(axis=1)
        alone[here] = found[numbers, given.single[here]]
        decoys[here] = np.fmax.reduce(reverse, axis=1, initial=-np.inf)
        if middle is not None:
            line = np.where(allowed, -_along(block, middle, inner), np.nan)
            fits[here] = line[numbers, match[here]]
            if np.isnan(chance[first]):
                chance[here] = [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in line]
        window, top = np.concatenate([last, found]), first - len(last)
        for step in range(-reach, reach + 1):
            queries = np.arange(max(top, top - step), min(here.stop, here.stop - step))
            beside[queries, reach + step] = window[queries + step - top, match[queries]]
        last = window[max(0, len(window) - reach) :]
    near = np.abs(_owner(beside)) <= max(REACH, count / width if given.two else 1.0)
    near &= middle is None or fits >= (chance + targets) / 2
    return Lines(setting, np.where(np.isneginf(targets), -1, match), targets, alone, decoys, near)


def _distances(scores: np.ndarray, which: np.ndarray) -> np.ndarray:
    return np.where(which, -scores, np.nan)


def _along(distances: np.ndarray, sequence: SequenceSettings | None, rows: range) -> np.ndarray:
    return distances[rows.start : rows.stop] if sequence is None else trajectory_costs(distances, sequence, rows)


def _owner(beside: np.ndarray) -> np.ndarray:
    """Return how many queries away that is which fits each match best, (Q,), by what those around score (Q, steps)."""
    reach = beside.shape[1] // 2
    steps = np.array([0, *range(-reach, 0), *range(1, reach + 1)])
    return steps[beside[:, reach + steps].argmax(axis=1)]


def best_setting(given: Candidates, precision: float) -> Lines | None:
    """Return the search that finds the most loops at this precision; None if none finds any."""
    chosen, most, shared = None, 0, dict[str, np.ndarray]()
    alone = [] if given.different is None else [Setting(None)]
    for setting in (*alone, *settings(given.scores.shape[0], given.scores.shape[1], given.two)):
        if most and np.count_nonzero(given.allowed.any(axis=1)) * NEARLY <= most:
            break  # no other can find more
        found = search(given, setting, shared)
        count = np.count_nonzero(found.accepted(precision))
        if count * NEARLY > most:
            chosen, most = found, count
    return chosen
