"""Whether the points of a stretch of matches speak against it (step 5 of :mod:`loopclosure.methods.auto`).

Matches of one place are verified as often as frames of one visit that are as similar; matches of different places as
rarely as other pairs of different places. Where frames of one visit are not verified either, as in images of 64x32,
points tell nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loopclosure.lines.chance import AGES, half_age
from loopclosure.lines.points import too_few
from loopclosure.methods.geometry import SAMPLE, Geometry


def temporal(scores: np.ndarray) -> np.ndarray:
    """Return the score (N, A) of each frame of one drive (N, N) with the frame before it, the one before that, ..."""
    count = len(scores)
    found = np.full((count, max(1, min(AGES, count - 1))), np.nan, scores.dtype)
    for age in range(1, min(AGES, count - 1) + 1):
        found[age:, age - 1] = np.diagonal(scores, -age)
    return found


@dataclass(frozen=True)
class Visits:
    """What frames of one visit, and pairs of different places, have in common.

    temporal  (N, A) see :func:`temporal`
    verified  whether two frames show the same points, by number
    unlike    how many pairs of different places did, and of how many
    """

    temporal: np.ndarray
    verified: Callable[[int, int], bool]
    unlike: tuple[int, int]

    @classmethod
    def of(cls, temporal: np.ndarray | None, geometry: Geometry, two: bool) -> Visits | None:
        """Return the visits of the queries; None if these cannot be compared with one another."""
        agree = geometry.among_queries(two)
        if agree is None or temporal is None:
            return None
        unlike = int(np.count_nonzero(geometry.unlike)), len(geometry.unlike)
        return cls(temporal, lambda a, b: geometry.evidence(agree(a, b)) >= 1, unlike)

    @cached_property
    def together(self) -> int:
        """How many frames in a row tell no more than one: the age at which half of the similarity has gone."""
        known = np.isfinite(self.temporal).any(axis=0)
        return half_age(np.nanmean(self.temporal[:, known], axis=0))

    def as_similar(self, similarity: float) -> tuple[int, int]:
        """Return how many pairs of frames of one visit, no more similar than this, are verified, and of how many."""
        low = self.temporal <= similarity
        frames = np.flatnonzero(low.any(axis=1))
        if not len(frames):
            return 0, 0
        frames = frames[np.unique(np.linspace(0, len(frames) - 1, SAMPLE).round().astype(int))]
        pairs = [(frame, frame - 1 - int(low[frame].argmax())) for frame in frames.tolist()]
        return sum(self.verified(*pair) for pair in pairs), len(pairs)

    def contradict(self, similarity: float, verified: int, tried: int) -> bool:
        """Return whether the ``verified`` of the ``tried`` matches of this similarity are too few for one place."""
        if 2 * verified >= tried:
            return False
        return too_few((verified, tried), self.together, self.as_similar(similarity), self.unlike)
