"""Step 2 of :mod:`loopclosure.methods.auto`: which pairs surely show different places, and what such pairs score.

A match that repeats a stretch of road lies on a line of similar pairs, in the direction in which time runs. Searched
for with the references in reverse order, the same matrix has lines too, as similar as different places get on this
camera. So the best reverse line of each query is a decoy: what its best forward line would score if it had no loop
(target-decoy competition: Elias and Gygi, "Target-decoy search strategy", Nature Methods 2007).

What is a decoy must be surely another place. Frames of one drive that are not old enough look alike on a straight road,
read forwards or backwards. And a reverse line that crosses the query's own best line sees the same place.
"""

from __future__ import annotations

import numpy as np

from loopclosure.methods.candidates import Candidates

SETTLED = 0.05  # of the way from the likeness of neighbors down to that of different places is left
ENOUGH = 0.5  # of the queries with a candidate must have frames that odometry puts far apart, for these to be decoys


def elsewhere(given: Candidates) -> tuple[np.ndarray, str]:
    """Return pairs (Q, R) bool that surely show different places unless the query has a loop, and say which.

    Of two traverses all. Of one drive those whose age, in frames, is at least that at which the mean likeness of frames
    by their age has come down to its floor.
    """
    if given.two:
        return given.allowed, ""
    age = floor_age(given.scores)
    numbers = np.arange(len(given.scores))
    old = np.subtract.outer(numbers, numbers) >= age
    return given.allowed & old, f"frames {age} apart look as unlike as different places do"


def floor_age(scores: np.ndarray) -> int:
    """Return the least age, in frames, at which frames (N, N) of one drive are as unlike as different places.

    The mean score by age has then come down to its median over all ages but for ``SETTLED`` of its fall.
    """
    count = len(scores)
    ages = np.arange(1, max(2, count - max(5, count // 20)))  # of the greatest there are too few pairs for a mean
    means = np.array([np.nanmean(np.diagonal(scores, -age)) if age < count else np.nan for age in ages])
    if not np.isfinite(means).any():
        return 1
    floor = np.nanmedian(means)
    low = np.flatnonzero(means <= floor + SETTLED * (means[0] - floor))
    return int(ages[low[0]]) if len(low) else count
