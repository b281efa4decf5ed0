"""Lines of similar pairs through each frame, and what chance makes as good: steps 2 and 3 of the decision.

A place that is passed again gives a line in the matrix of scores, in the direction of time. If the frames are read in
the other direction, the same matrix has lines too, as similar as different places get with this camera. So the best
line of each frame the other way, elsewhere, is a decoy: its score is what the best line of a frame without a loop would
have (target-decoy competition: Elias and Gygi, "Target-decoy search strategy", Nature Methods 2007).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopclosure.decision.constants import (
    LEAST_PIECES,
    LEAST_TAIL,
    LENGTHS,
    MIDDLE,
    TAIL,
    VELOCITIES,
    WINDOW,
)
from loopclosure.decision.growing import Growing
from loopclosure.decision.trajectories import SequenceSettings, trajectory_costs
from netspec.files.opencv import cv2

HALF = LENGTHS[-1] // 2  # frames after one that its longest line needs
NONE = -np.inf


@dataclass(frozen=True)
class Course:
    """How lines run: steps of a line, references for a query, and whether the references are passed backwards."""

    length: int
    speed: float = 1.0
    backwards: bool = False

    def sequence(self, length: int | None = None) -> SequenceSettings:
        """The search for such lines, among references in the order in which they are passed."""
        slowest, fastest, step = (self.speed * velocity for velocity in VELOCITIES)
        return SequenceSettings(length or self.length, slowest, fastest, step, contrast=0)


def courses(speeds: Sequence[float] = (1.0,)) -> list[Course]:
    """Return the courses of all lengths at some speeds, each followed by the one backwards.

    Lines are longer where they would pass fewer references than they have steps: these tell no more than one.
    """
    ways = [(round(n / min(1.0, speed)), speed) for speed in speeds for n in LENGTHS]
    return [Course(length, speed, backwards) for length, speed in ways for backwards in (False, True)]


class Lines:
    """The best line of each query, on each of some courses, and its decoy."""

    def __init__(self, on: Sequence[Course]) -> None:
        self.courses = list(on)
        # Of each course, for the best line of each query: the reference, the score and the decoy's score, the score of
        # its middle, what such a middle scores by chance, and the similarity of the query and the reference.
        self._found = [Growing(6) for _ in on]
        self._rows: list[np.ndarray] = []  # what stands out, of the last queries
        self._scores: list[np.ndarray] = []
        self._first = 0  # the query of the first of these
        self._width = 0  # references
        self._pairs = [np.zeros(3) for _ in on]  # from which lines were chosen, and decoys; the sum of their spreads

    def __len__(self) -> int:
        return len(self._found[0])

    def add(self, outstanding: np.ndarray, scores: np.ndarray) -> None:
        """Add a query by its scores (R,), and by how much they stand out from those around; NaN for no candidate."""
        self._rows.append(outstanding)
        self._width = max(self._width, len(scores))
        self._scores.append(scores)

    @property
    def added(self) -> int:
        """How many queries were added; the lines of the last ones may not be known yet."""
        return self._first + len(self._rows)

    def search(self, end: int) -> None:
        """Find the lines of all queries before ``end``."""
        if end <= len(self):
            return
        rows = range(len(self) - self._first, end - self._first)
        width = self._width
        distances = np.full((len(self._rows), width), np.nan, np.float32)
        for row, values in zip(distances, self._rows, strict=True):
            row[: len(values)] = values
        middles: dict[tuple[float, bool], np.ndarray] = {}
        for number in range(0, len(self.courses), 2):
            pair = self.courses[number : number + 2]
            ways = [_costs(distances, course, course.length, rows) for course in pair]
            for k, course in enumerate(pair):
                at = course.speed, course.backwards
                if at not in middles:
                    middles[at] = _costs(distances, course, MIDDLE, rows)
                self._take(number + k, rows, ways[k], ways[1 - k], middles[at])
        drop = max(0, end - max(course.length for course in self.courses) - self._first)
        del self._rows[:drop], self._scores[:drop]
        self._first += drop

    def _take(self, number: int, rows: range, own: np.ndarray, other: np.ndarray, middle: np.ndarray) -> None:
        """Note the best of the scores ``own`` (n, R) of lines, and of those in the other direction."""
        length, each = self.courses[number].length, np.arange(len(own))
        if not own.shape[1]:
            self._found[number].append(np.tile([[-1], [NONE], [NONE], [NONE], [0.0], [NONE]], len(own)))
            return
        match = own.argmax(axis=1)
        crossed = np.abs(np.arange(own.shape[1]) - match[:, None]) <= length  # these show the same place
        there = np.isfinite(own)
        spread = sum(_spread(row[known]) for row, known in zip(own, there, strict=True))
        self._pairs[number] += there.sum(), (there & ~crossed).sum(), spread
        decoy = np.where(crossed, NONE, other).max(axis=1)
        known = [row[np.isfinite(row)] for row in middle]
        chance = [np.median(row) if len(row) else 0.0 for row in known]
        score = np.where(np.isfinite(decoy), own[each, match], NONE)  # of what has no decoy nothing is known
        similar = [
            self._scores[row][at] if at < len(self._scores[row]) else NONE for row, at in zip(rows, match, strict=True)
        ]
        match = np.where(np.isneginf(score), -1, match)
        self._found[number].append(np.array([match, score, decoy, middle[each, match], chance, similar]))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that a file must store to continue."""
        rows = np.full((2, len(self._rows), self._width), np.nan, np.float32)
        for of, values in zip(rows, (self._rows, self._scores), strict=True):
            for row, each in zip(of, values, strict=True):
                row[: len(each)] = each
        return {
            "lines_found": np.array([found.array for found in self._found]),
            "lines_rows": rows,
            "lines_lengths": np.array([len(row) for row in self._rows], np.int64),
            "lines_pairs": np.array(self._pairs),
            "lines_first": np.array([self._first, self._width]),
        }

    def take(self, arrays: dict[str, Any]) -> None:
        """Continue from the arrays of a file. Raises LookupError, TypeError or ValueError if they do not fit."""
        for found, each in zip(self._found, arrays["lines_found"], strict=True):
            found.append(np.asarray(each, np.float64))
        lengths = arrays["lines_lengths"].astype(int).tolist()
        self._rows, self._scores = (
            [row[:length].astype(np.float32) for row, length in zip(of, lengths, strict=True)]
            for of in arrays["lines_rows"]
        )
        self._pairs = list(arrays["lines_pairs"].astype(np.float64).reshape(len(self._found), 3))
        self._first, self._width = map(int, arrays["lines_first"])

    def best(self, first: int, end: int) -> Best:
        """Return the best lines of some queries by now, of the course on which chance makes one as good least often."""
        count = len(self)
        wrong, near = np.full((len(self.courses), count), np.inf), np.zeros((len(self.courses), count), bool)
        for number, course in enumerate(self.courses):
            wrong[number], near[number] = self._by_chance(number, course)
        of = np.lexsort((wrong, ~near), axis=0)[0, first:end] if count else np.zeros(0, int)
        each = np.arange(count)[first:end]
        match, score, decoy, similar = (np.array([f.array[k] for f in self._found])[of, each] for k in (0, 1, 2, 5))
        return Best(self.courses, of, match.astype(int), score, decoy, similar, np.where(near, wrong, np.inf)[of, each])

    def _by_chance(self, number: int, course: Course) -> tuple[np.ndarray, np.ndarray]:
        """Return how many wrong lines as good as that of each query (Q,) are expected in all, and whether it is near.

        Above a level the decoys are taken to fall exponentially (the peaks over a threshold of extreme-value theory),
        with a scale that is widened by the uncertainty of the few independent decoys there are; inf where too little is
        known. Scores that are already those of sequences vary more along lines in the direction of time, so decoys are
        scaled by the ratio of the spreads, as far as it is known. Near is a line with the place itself on it: at the
        end of a loop, the line through its last place is the best for a while.
        """
        _, score, decoy, middle, chance, _ = self._found[number].array
        wrong, decoys = np.full(len(score), np.inf), np.sort(decoy[np.isfinite(decoy)])[::-1]
        (pairs, chances, spread), (*_, other) = self._pairs[number], self._pairs[number ^ 1]
        tail = max(LEAST_TAIL, int(TAIL * len(decoys)))
        pieces = len(decoys) * self._width / course.speed / course.length**2
        if pieces < LEAST_PIECES or len(decoys) < 4 * LEAST_TAIL:
            return wrong, np.zeros(len(score), bool)
        decoys *= max(1.0, spread / (other + 1e-12)) ** (1 - LEAST_PIECES / pieces)
        level = decoys[tail]
        scale = (decoys[:tail] - level).mean() * (1 + np.sqrt(course.length / 2 / tail)) + 1e-12
        odds = max(1.0, pairs / max(1.0, chances)) * len(self.courses) / len(LENGTHS)
        whole = cv2.dilate(np.maximum(score, chance)[None], np.ones((1, course.length + 1)))[0]
        wrong = odds * tail * np.exp(-np.maximum(score - level, 0) / scale)
        return wrong, (middle >= (chance + whole) / 2) & (score > level)


@dataclass(frozen=True)
class Best:
    """The best line of each query (Q,).

    of       its course, a number of ``courses``
    match    its reference, -1 without one
    score    of the line, -inf without one
    decoy    of the line elsewhere, the other way
    similar  the score of the query and the reference
    wrong    how many lines as good are expected in the whole drive by chance; inf where that is not known
    """

    courses: list[Course]
    of: np.ndarray
    match: np.ndarray
    score: np.ndarray
    decoy: np.ndarray
    similar: np.ndarray
    wrong: np.ndarray


def _spread(scores: np.ndarray) -> float:
    """Return the median deviation of scores (n,), which the few lines of true loops do not change; 0 of none."""
    return float(np.median(np.abs(scores - np.median(scores)))) if len(scores) else 0.0


def _costs(distances: np.ndarray, course: Course, length: int, rows: range) -> np.ndarray:
    """Return the scores (n, R) of the best lines through some queries and each reference, -inf where there is none."""
    first, last = max(0, rows.start - length), min(rows.stop + length, len(distances))
    around = distances[first:last, :: -1 if course.backwards else 1]
    costs = trajectory_costs(around, course.sequence(length), range(rows.start - first, rows.stop - first))
    costs = costs[:, :: -1 if course.backwards else 1]
    return np.where(np.isfinite(distances[rows.start : rows.stop]) & np.isfinite(costs), -costs, NONE)


def neighbors(match: np.ndarray, speed: np.ndarray, backwards: np.ndarray) -> np.ndarray:
    """Return pairs (N, 2) of queries, the earlier first, whose matches (Q,) lie on the line through one another.

    The line has the speed (Q,) and the direction (Q,) bool of that of the later query, and is ``WINDOW`` references
    wide to each side.
    """
    pairs = []
    slowest, fastest, _ = VELOCITIES
    for step in range(1, HALF + 1):
        ahead = (match[step:] - match[:-step]) * np.where(backwards[step:], -1, 1)
        way = step * speed[step:]
        earlier = np.flatnonzero((slowest * way - WINDOW <= ahead) & (ahead <= fastest * way + WINDOW))
        pairs.append(np.stack([earlier, earlier + step], axis=1))
    return np.concatenate(pairs)
