"""Which pairs can be loops at all: not those of one visit to a place, nor those that odometry puts far apart."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loopclosure.methods.base import BLOCK, earlier
from loopclosure.places.same_place import MAX_DISTANCE_M

DRIFT = 0.1  # of the way: more than odometry is usually off
FAR_M = 2 * MAX_DISTANCE_M  # from there on two frames show different places
AWAY = 2  # frames in a row
STILL = 0.5  # of a usual step from frame to frame
STOP = 8  # steps
MOVES = 0.9  # the quantile of steps at which the search for a usual one begins
ENOUGH = 0.5  # of the queries with a candidate must have frames far apart, for these to show how others score


@dataclass(frozen=True)
class Candidates:
    """Pairs (Q, R) that can be loops.

    scores     higher = more alike
    allowed    which pairs are candidates
    two        two traverses, or one sequence with itself
    queries, references  the numbers of the frames that these are, in the whole drive
    stands     (N,) for each query of the whole drive, the row of the frame that shows the same, or is it
    different  pairs that are known to show different places; None: not known of enough queries
    said       how long a visit to a place lasts, in a sentence; empty for two traverses
    """

    scores: np.ndarray
    allowed: np.ndarray
    two: bool
    queries: np.ndarray
    references: np.ndarray
    stands: np.ndarray
    different: np.ndarray | None = None
    said: str = ""

    def known(self, queries: slice | int = slice(None)) -> np.ndarray:
        """Return the scores of the candidates of queries (n, R), or of one (R,), -inf elsewhere."""
        return np.where(self.allowed[queries], self.scores[queries], -np.inf)

    @cached_property
    def single(self) -> np.ndarray:
        """The best candidate (Q,) of each query by its score alone; any where there is none."""
        blocks = (slice(first, first + BLOCK) for first in range(0, len(self.queries) or 1, BLOCK))
        return np.concatenate([self.known(block).argmax(axis=1) for block in blocks])

    @property
    def others(self) -> str:
        """What shows how different places score."""
        return "where the drive is read backwards" if self.different is None else "far apart in the odometry"


def candidates(
    scores: np.ndarray, allowed: np.ndarray, two: bool, far: np.ndarray | None, visit: int | None
) -> Candidates:
    """Return the pairs that can be loops, of frames in which the camera has moved.

    The arguments are those of :func:`loopclosure.methods.auto.answer`.
    """
    if not two and visit is not None:
        allowed = allowed & earlier(len(scores), visit)
    queries, stands = moved(scores)
    references = moved(scores.T)[0] if two else queries
    if (len(queries), len(references)) != scores.shape:
        part = np.ix_(queries, references)
        scores, allowed, far = scores[part], allowed[part], None if far is None else far[part]
    allowed, different, said = allowed & np.isfinite(scores), None, ""
    if far is not None:
        different, allowed = allowed & far, allowed & ~far
        if np.count_nonzero(different.any(axis=1)) < ENOUGH * np.count_nonzero(allowed.any(axis=1)):
            different = None
    if visit is not None:
        said = f"one visit to a place lasts {visit} frames, as was said"
    elif not two:
        back, lasted = _returned(scores, allowed, queries)
        allowed &= back
        said = f"one visit to a place lasts {np.median(lasted):.0f} frames as a rule, {lasted.max()} at most"
    return Candidates(scores, allowed, two, queries, references, stands, different, said)


def moved(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames, rows of scores (N, M), in which the camera has moved, and which of them each frame (N,) shows.

    Where a robot stands, for ``STOP`` steps or more that are on average less than ``STILL`` of a usual step, one frame
    is taken while the others are within that of it: lines through all of them would lead past the place. They show the
    same as that one, or as the next where that is more alike. The usual step is one of a robot that moves, though it
    may stand for most of the time: the median of those that are no stop.
    """

    def step(a: int, b: int) -> float:
        both = np.isfinite(scores[a]) & np.isfinite(scores[b])
        return float(np.sqrt(np.mean((scores[a, both] - scores[b, both]) ** 2))) if both.any() else np.inf

    steps = np.array([step(i, i + 1) for i in range(len(scores) - 1)])
    if len(steps) < STOP:
        return np.arange(len(scores)), np.arange(len(scores))
    means = np.convolve(steps, np.full(STOP, 1 / STOP), "valid")
    known = np.append(0.0, means[np.isfinite(means)])
    usual, before = np.quantile(known, MOVES), np.inf
    while usual < before:
        usual, before = np.median(known[known >= STILL * usual]), usual
    still = np.convolve(means < STILL * usual, np.ones(STOP)) > 0
    taken, stands, first = list[int](), list[int](), 0
    while first < len(scores):
        end = first + 1
        while end < len(scores) and still[end - 1] and step(first, end) < STILL * usual:
            end += 1
        if end - first <= STOP:
            end = first + 1
        following = [end < len(scores) and step(i, end) < step(first, i) for i in range(first + 1, end)]
        stands += [len(taken), *(len(taken) + later for later in following)]
        taken.append(first)
        first = end
    return np.array(taken), np.array(stands)


def _returned(scores: np.ndarray, allowed: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which pairs (n, n) of ``frames`` (n,) have a leave-taking between them, and how long each visit lasts.

    A visit to a frame's place ends with ``AWAY`` frames in a row that are as unlike it as different places are: the
    median of all. A camera that stands, or a straight road, is like itself for long; that is no loop.
    """
    count = len(scores)
    numbers = np.arange(count)
    if not allowed.any():
        return allowed, np.full(count, count)
    usual = np.median(scores[allowed], overwrite_input=True)
    left, entered = np.full(count, count), np.full(count, -1)
    for first in range(0, count - AWAY + 1, BLOCK):
        rows = numbers[first : min(first + BLOCK, count - AWAY + 1), None]
        # From frame i on away from frame j.
        away = np.logical_and.reduce([scores[first + k : first + k + len(rows)] <= usual for k in range(AWAY)])
        after, before = away & (rows > numbers), away & (rows + AWAY <= numbers)
        left = np.where((left == count) & after.any(axis=0), first + after.argmax(axis=0), left)
        entered = np.where(before.any(axis=0), rows[-1] - before[::-1].argmax(axis=0), entered)
    back = numbers[:, None] >= left + AWAY
    back &= numbers < entered[:, None]
    return back, frames[np.minimum(left, count - 1)] - frames


def far_apart(poses: np.ndarray) -> np.ndarray:
    """Return which frames (N, N) bool odometry puts far apart.

    poses  (N, 7) of odometry in meters, in the order of time; NaN where it is not known
    """
    positions = poses[:, :3]
    known = np.all(np.isfinite(positions), axis=1)
    way = np.zeros(len(poses))
    way[known] = np.cumsum(np.linalg.norm(np.diff(positions[known], axis=0, prepend=positions[known][:1]), axis=1))
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    return apart > FAR_M + DRIFT * np.abs(np.subtract.outer(way, way))  # False for NaN
