"""Lines of similar pairs while frames arrive: what :mod:`loopclosure.methods.lines` finds in a whole drive.

Each score counts by how far it stands out from those of the frames around, as in SeqSLAM: in another season or light
all scores are lower, or all higher. A line is searched through the frame that is ``HALF`` frames old, forwards and
backwards; the best line the other way, at another place, shows how well chance does.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from loopclosure.lines.chance import AGES, half_age, oldest, settled_age, threshold
from loopclosure.lines.course import Course
from loopclosure.lines.trajectories import trajectory_costs

HALF = 10  # frames before and after the middle of a line, which is found so many frames late
AROUND = 2 * HALF + 1  # frames around one, from whose scores its own stands out
PRECISION = 0.99  # of the matches whose lines are accepted
LEAST_PIECES = 50  # pieces of the length of a line, squared, that show what chance does
FIRST_ROOM = 256  # frames; doubled when full


@dataclass(frozen=True)
class Line:
    """The best line through a frame ``query``, and whether it is a loop by its score alone.

    match       the frame that it passes then
    other       the score of the best line in the other direction, elsewhere
    similarity  the score of the two images
    """

    query: int
    match: int
    course: Course
    score: float
    other: float
    similarity: float
    accepted: bool = False


class OnlineLines:
    """Finds the best line through each frame, ``HALF`` frames late, and knows which places were left."""

    def __init__(self) -> None:
        self.count = 0
        self._begin = 0  # of the session
        self._left, self._away = np.zeros((2, 0), bool)  # whether the place of a frame was left, and was away last
        self._usual: list[float] = []  # the median score of each frame
        self._ages = np.zeros((2, 0))  # the sum of the scores of frames so far apart, and their number
        self._rows: deque[np.ndarray] = deque(maxlen=2 * HALF + 1)  # what stands out, of the last frames
        self._scores: deque[np.ndarray] = deque(maxlen=HALF + 1)
        self._known: dict[bool, list[tuple[float, float]]] = {False: [], True: []}  # lines and decoys, by direction
        self._pairs, self._chances = 0, 0  # that lines and decoys were chosen from

    def begin_session(self, count: int) -> None:
        """Start another drive after ``count`` frames; all of them are candidates."""
        self._room(count)
        self._begin = count
        self._left[:count] = True
        self._ages[:] = 0
        self._rows.clear()
        self._scores.clear()

    def left(self, frame: int) -> bool:
        """Whether the place of a frame was left since: two frames in a row differed from it as others do.

        On a straight road frames stay alike for long; that is no loop.
        """
        return frame >= self.count or bool(self._left[frame])

    def add(self, scores: np.ndarray, end: int, by_visit: bool) -> Line | None:
        """Add a frame by its scores (N,) with all earlier ones, and return the line through that ``HALF`` before it.

        end       how many frames are old enough to be its candidates
        by_visit  whether its visit must have ended since: nothing else says how old a candidate must be
        """
        count, begin = len(scores), self._begin
        if count > self.count:  # frames that were only remembered
            self.begin_session(count)
            begin = count
        self._room(count + 1)
        self.count = count + 1
        entered = self._see(scores)
        row = -scores[: min(end, max(begin, count - self._floor(scores[begin:])))].astype(np.float64)
        if by_visit:
            row[~self._left[: len(row)]] = np.nan
            row[max(begin, entered) :] = np.nan
        self._rows.append(outstanding(row))
        self._scores.append(scores)
        return self._line(count - HALF) if len(self._rows) > HALF else None

    def as_similar(self, line: Line) -> int | None:
        """Return the newest frame of the visit of a line's query that is no more similar to it than its match."""
        recent = self._scores[0][max(self._begin, line.query - AGES) :]
        low = np.flatnonzero(recent <= line.similarity)
        return line.query - len(recent) + int(low[-1]) if len(low) else None

    @property
    def together(self) -> int:
        """How many frames in a row tell no more than one: the age at which half of the similarity has gone."""
        total, number = self._ages[:, :AGES][:, self._ages[1, :AGES] > 0]
        return half_age(total / number)

    def _room(self, count: int) -> None:
        self._left, self._away, self._ages = (_grown(each, count) for each in (self._left, self._away, self._ages))

    def _see(self, scores: np.ndarray) -> int:
        """Note which visits ended, and return where that of the new frame began, -1 if it has not."""
        if len(scores) < 2:
            return -1
        self._usual.append(float(np.median(scores)))
        own = slice(self._begin, len(scores))
        away = scores[own] <= np.median(self._usual)
        self._left[own] |= away & self._away[own]
        self._away[own] = away
        both = np.flatnonzero(away[1:] & away[:-1])
        return self._begin + int(both[-1]) if len(both) else -1

    def _floor(self, own: np.ndarray) -> int:
        """Return the age from which on frames of this drive are as dissimilar as different places."""
        count = len(own)
        self._ages[:, :count] += own[::-1], np.ones(count)
        total, number = self._ages[:, : min(count, oldest(count + 1))]
        return settled_age(total / number, count + 1) if count else 1

    def _line(self, query: int) -> Line | None:
        at = len(self._rows) - 1 - HALF
        distances = np.full((len(self._rows), max(map(len, self._rows))), np.nan, np.float32)
        for row, values in zip(distances, self._rows, strict=True):
            row[: len(values)] = values
        candidates = np.isfinite(distances[at])
        if not candidates.any():
            return None
        found, courses = [], [Course(2 * HALF, backwards=backwards) for backwards in (False, True)]
        for course in courses:
            way = slice(None, None, -1 if course.backwards else 1)
            costs = trajectory_costs(distances[:, way], course.sequence, range(at, at + 1))[0, way]
            found.append(np.where(candidates & np.isfinite(costs), -costs, -np.inf))
        number = np.count_nonzero(candidates)
        self._pairs += number
        self._chances += max(0, number - 4 * HALF - 1)  # a decoy does not cross the line
        lines = []
        for course, own, other in zip(courses, found, found[::-1], strict=True):
            match = int(own.argmax())
            other = np.concatenate([other[: max(0, match - 2 * HALF)], other[match + 2 * HALF + 1 :], [-np.inf]])
            similarity = float(self._scores[0][match])
            lines.append(self._judged(Line(query, match, course, float(own[match]), float(other.max()), similarity)))
        return max(lines, key=lambda line: (line.accepted, line.score))

    def _judged(self, line: Line) -> Line:
        """Return whether a line is better than chance, as far as chance is known by now."""
        if not np.isfinite(line.other):
            return line
        known = self._known[line.course.backwards]
        known.append((line.score, line.other))
        if self._pairs < LEAST_PIECES * line.course.length**2:
            return line
        targets, decoys = np.array(known).T
        odds = max(1.0, self._pairs / max(1, self._chances))
        return replace(line, accepted=line.score >= threshold(targets, decoys, PRECISION, line.course.length / 2, odds))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that a file must store to continue."""
        rows, scores = (np.full((len(each), self.count), np.nan, np.float32) for each in (self._rows, self._scores))
        for row, values in zip((*rows, *scores), (*self._rows, *self._scores), strict=True):
            row[: len(values)] = values
        return {
            "lines_visits": np.stack([self._left[: self.count], self._away[: self.count]]),
            "lines_usual": np.array(self._usual),
            "lines_ages": self._ages[:, : self.count],
            "lines_rows": rows,
            "lines_scores": scores,
            "lines_forwards": np.array(self._known[False], np.float32).reshape(-1, 2),
            "lines_backwards": np.array(self._known[True], np.float32).reshape(-1, 2),
            "lines_counts": np.array([self.count, self._begin, self._pairs, self._chances]),
        }

    def take(self, arrays: dict[str, Any]) -> None:
        """Continue from the arrays of a file. Raises LookupError, TypeError or ValueError if they do not fit."""
        self.count, self._begin, self._pairs, self._chances = map(int, arrays["lines_counts"])
        self._left, self._away = arrays["lines_visits"].astype(bool).reshape(2, self.count)
        self._usual = arrays["lines_usual"].tolist()
        self._ages = arrays["lines_ages"].astype(float).reshape(2, self.count)
        self._rows.extend(_matrix(arrays["lines_rows"], self.count))
        scores = _matrix(arrays["lines_scores"], self.count)
        self._scores.extend(row[: self.count - len(scores) + k] for k, row in enumerate(scores))
        for backwards, name in ((False, "lines_forwards"), (True, "lines_backwards")):
            self._known[backwards] = [(float(a), float(b)) for a, b in _matrix(arrays[name], 2)]


def outstanding(distances: np.ndarray) -> np.ndarray:
    """Return (distance - mean) / deviation (N,) float32, both of the ``AROUND`` frames around; NaN where not known.

    No deviation counts as less than the median: a black frame differs little from all others.
    """
    known = np.isfinite(distances)
    if not known.any():
        return np.full(len(distances), np.nan, np.float32)
    share = np.maximum(_around(known.astype(np.float64)), 1 / AROUND)
    values = np.where(known, distances - distances[known].mean(), 0)
    values = np.where(known, values - _around(values) / share, 0)
    deviations = np.sqrt(np.maximum(_around(np.square(values)), 0) / share)
    usual = max(float(np.median(deviations[known])), 1e-12)
    return np.where(known, values / np.maximum(deviations, usual), np.nan).astype(np.float32)


def _around(values: np.ndarray) -> np.ndarray:
    return uniform_filter1d(values, AROUND, mode="constant")


def _matrix(array: np.ndarray, width: int) -> np.ndarray:
    """Check the width of an array (n, width) of a file. Raises ValueError."""
    return array.astype(np.float32).reshape(len(array), width)


def _grown(array: np.ndarray, count: int) -> np.ndarray:
    """Return an array (..., n) with room for ``count`` columns, new ones 0; its size doubles."""
    size = array.shape[-1]
    if count <= size:
        return array
    more = max(FIRST_ROOM, count, 2 * size) - size
    return np.concatenate([array, np.zeros((*array.shape[:-1], more), array.dtype)], axis=-1)
