"""Step 1 of :mod:`loopclosure.methods.auto`: finds the pairs of frames that can be loops.

Pairs of one visit to a place, and pairs that are far apart by odometry, cannot. While the camera does not move, only
one frame counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loopclosure.methods.base import BLOCK
from loopclosure.places.same_place import MAX_DISTANCE_M

DRIFT = 0.1  # of the distance traveled: more than the usual error of odometry
FAR_M = 2 * MAX_DISTANCE_M  # at this distance and beyond, two frames show different places
AWAY = 2  # frames in a row
STILL = 0.5  # of the usual difference between consecutive frames
STOP = 8  # steps
MOVES = 0.9  # the quantile of differences at which the search for the usual one begins


@dataclass(frozen=True)
class Compared:
    """Compared frames, and other information about them.

    scores    (Q, R), higher = more similar; queries and references are each in the order of time
    allowed   (Q, R) bool: pairs that may be loops
    two       two traverses; False: one drive, compared with itself
    far       (Q, R) bool: pairs that are far apart by odometry; None without odometry
    visit     for one drive: a reference is a candidate if it is more than this many frames older; None: found
              automatically
    temporal  (Q, A) the score of each query with the query before it, the one before that, ...; NaN where there is
              none. Of one drive they are found in ``scores``; None: not known
    """

    scores: np.ndarray
    allowed: np.ndarray
    two: bool
    far: np.ndarray | None = None
    visit: int | None = None
    temporal: np.ndarray | None = None


@dataclass(frozen=True)
class Candidates:
    """Pairs (Q, R) that can be loops, for the frames in which the camera has moved.

    scores     higher = more similar
    allowed    which pairs are candidates
    two        two traverses, or one drive with itself
    queries, references  the numbers of these frames in the whole drive
    stands     (N,) for each query of the whole drive, the row of the last of these frames that is not later
    far        pairs that are far apart by odometry; None without odometry
    said       a sentence about how long a visit to a place lasts; empty for two traverses
    """

    scores: np.ndarray
    allowed: np.ndarray
    two: bool
    queries: np.ndarray
    references: np.ndarray
    stands: np.ndarray
    far: np.ndarray | None = None
    said: str = ""

    @cached_property
    def there(self) -> np.ndarray:
        """Whether each query (Q,) has a candidate."""
        return np.any(self.allowed, axis=1)

    @cached_property
    def single(self) -> np.ndarray:
        """The candidate (Q,) of each query with the best score; arbitrary if it has none."""
        rows = zip(self.allowed, self.scores, strict=True)
        return np.array([np.where(allowed, scores, -np.inf).argmax() for allowed, scores in rows], int)

    @cached_property
    def best(self) -> np.ndarray:
        """The score (Q,) of ``single``; -inf for a query that has no candidate."""
        best = np.full(len(self.queries), -np.inf)
        best[self.there] = self.scores[self.there, self.single[self.there]]
        return best

    def numbers(self, query: int, reference: int) -> tuple[int, int]:
        """Return the numbers of two frames, given by row and column, in the whole drive."""
        return int(self.queries[query]), int(self.references[reference])


def candidates(compared: Compared) -> Candidates:
    """Return the pairs that can be loops."""
    scores, allowed, two, far = compared.scores, compared.allowed, compared.two, compared.far
    queries = moved(scores)
    references = moved(scores.T) if two else queries
    stands = np.searchsorted(queries, np.arange(len(scores)), side="right") - 1
    if (len(queries), len(references)) != scores.shape:
        part = np.ix_(queries, references)
        scores, allowed, far = scores[part], allowed[part], None if far is None else far[part]
    allowed, said = allowed & np.isfinite(scores), ""
    if not two and compared.visit is not None:
        allowed &= queries[:, None] > queries + compared.visit
        said = f"one visit to a place lasts {compared.visit} frames, as given"
    if far is not None:
        far, allowed = allowed & far, allowed & ~far
    if not two and compared.visit is None:
        back, lasted = _returned(scores, allowed, queries)
        allowed &= back
        said = f"one visit to a place lasts {np.median(lasted):.0f} frames (median), {lasted.max()} at most"
    return Candidates(scores, allowed, two, queries, references, stands, far, said)


def moved(scores: np.ndarray) -> np.ndarray:
    """Return the frames, rows of scores (N, M), in which the camera has moved.

    The robot has stopped if ``STOP`` or more differences between consecutive frames are on average less than ``STILL``
    of the usual difference. Then one frame represents all frames that differ less than that from it; lines through all
    of them would lead past the place. The usual difference is the median over frames in motion, because a robot may
    stand still most of the time.
    """

    def step(a: int, b: int) -> float:
        both = np.isfinite(scores[a]) & np.isfinite(scores[b])
        return float(np.sqrt(np.mean((scores[a, both] - scores[b, both]) ** 2))) if both.any() else np.inf

    steps = np.array([step(i, i + 1) for i in range(len(scores) - 1)])
    if len(steps) < STOP:
        return np.arange(len(scores))
    means = np.convolve(steps, np.full(STOP, 1 / STOP), "valid")
    known = np.append(0.0, means[np.isfinite(means)])
    usual, before = np.quantile(known, MOVES), np.inf
    while usual < before:
        usual, before = np.median(known[known >= STILL * usual]), usual
    still = np.convolve(means < STILL * usual, np.ones(STOP)) > 0
    taken, first = list[int](), 0
    while first < len(scores):
        end = first + 1
        while end < len(scores) and still[end - 1] and step(first, end) < STILL * usual:
            end += 1
        taken.append(first)
        first = end if end - first > STOP else first + 1
    return np.array(taken)


def _returned(scores: np.ndarray, allowed: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for which pairs (n, n) of ``frames`` (n,) the place was left in between, and how long each visit lasts.

    A visit to the place of a frame ends with ``AWAY`` consecutive frames that differ from it as much as different
    places do, which is the median of all pairs. Frames of a standing camera or of a straight road stay similar for
    a long time; that is not a loop.
    """
    count = len(scores)
    numbers = np.arange(count)
    if not allowed.any():
        return allowed, np.full(count, count)
    usual = np.median(scores[allowed], overwrite_input=True)
    left, entered = np.full(count, count), np.full(count, -1)
    for place, frame_scores in enumerate(scores.T):
        differs = np.convolve(frame_scores <= usual, np.ones(AWAY, int), "valid") == AWAY
        away = np.flatnonzero(differs)  # there and AWAY - 1 frames later
        before, after = np.searchsorted(away, (place - AWAY, place), side="right")
        if after < len(away):
            left[place] = away[after]
        if before:
            entered[place] = away[before - 1]
    # A turn of the road ends the visit of what was straight ahead within a second: no visit is shorter than is usual.
    left = np.maximum(left, numbers + int(np.median(left - numbers)))
    back = (numbers[:, None] >= left + AWAY) & (numbers < entered[:, None])
    return back, frames[np.minimum(left, count - 1)] - frames


def far_apart(poses: np.ndarray) -> np.ndarray:
    """Return which frames (N, N) bool are far apart by odometry.

    poses  (N, 7) of odometry in meters, in the order of time; NaN if not known
    """
    positions = poses[:, :3]
    known = np.all(np.isfinite(positions), axis=1)
    way = np.zeros(len(poses))
    way[known] = np.cumsum(np.linalg.norm(np.diff(positions[known], axis=0, prepend=positions[known][:1]), axis=1))
    far = np.zeros((len(poses), len(poses)), bool)
    for first in range(0, len(poses), BLOCK):
        rows = slice(first, first + BLOCK)
        apart = np.sqrt(sum(np.square(np.subtract.outer(of[rows], of)) for of in positions.T))
        far[rows] = apart > FAR_M + DRIFT * np.abs(np.subtract.outer(way[rows], way))  # False for NaN
    return far
