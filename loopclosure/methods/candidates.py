"""Which pairs can be loops at all: not those of one visit to a place, nor those that odometry puts far apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopclosure.methods.base import earlier
from loopclosure.places.same_place import MAX_DISTANCE_M

DRIFT = 0.1  # of the way: more than odometry is usually off
FAR_M = 2 * MAX_DISTANCE_M  # from there on two frames show different places
ENOUGH = 0.5  # of the queries with a candidate must have frames far apart, for these to show how others score


@dataclass(frozen=True)
class Candidates:
    """Pairs (Q, R) that can be loops.

    scores     higher = more alike
    allowed    which pairs are candidates
    two        two traverses, or one sequence with itself
    different  pairs that are known to show different places; None: not known of enough queries
    """

    scores: np.ndarray
    allowed: np.ndarray
    two: bool
    different: np.ndarray | None = None

    @property
    def known(self) -> np.ndarray:
        """The scores of candidates (Q, R), -inf elsewhere."""
        return np.where(self.allowed, self.scores, -np.inf)

    @property
    def others(self) -> str:
        """What shows how different places score."""
        return "backwards" if self.different is None else "far apart in odometry"


def candidates(scores: np.ndarray, allowed: np.ndarray, two: bool, far: np.ndarray | None) -> Candidates:
    """Return the pairs that can be loops; the arguments are those of :func:`loopclosure.methods.auto.answer`."""
    allowed, different = allowed & np.isfinite(scores), None
    if far is not None:
        different, allowed = allowed & far, allowed & ~far
        if np.count_nonzero(different.any(axis=1)) < ENOUGH * np.count_nonzero(allowed.any(axis=1)):
            different = None
    if not two:
        allowed &= earlier(len(scores), _visit(scores, allowed))
    return Candidates(scores, allowed, two, different)


def _visit(scores: np.ndarray, allowed: np.ndarray) -> int:
    """Return how many frames a visit to a place takes in one drive: so many are as unlike as different places are.

    A camera that stands, or a straight road, is like itself for long; that is no loop.
    """
    lags = [(k, np.median(known)) for k in range(1, len(scores)) if len(known := _finite(np.diagonal(scores, -k)))]
    visit, before = 0, -1
    while visit > before and np.any(apart := allowed & earlier(len(scores), visit)):
        different = np.median(scores[apart])
        visit, before = next((k - 1 for k, alike in lags if alike <= different), visit), visit
    return visit


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


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
