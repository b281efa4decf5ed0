"""Step 2 of :mod:`loopclosure.methods.auto`: finds pairs that certainly show different places, and their scores.

A match on a stretch of road that is driven again lies on a line of similar pairs, in the direction of time. If the
references are searched in reverse order, the same matrix has lines too, as similar as different places get with this
camera. So the best reverse line of each query is a decoy: its score is what the best forward line of a query without
a loop would have (target-decoy competition: Elias and Gygi, "Target-decoy search strategy", Nature Methods 2007).

A decoy must certainly show another place. Frames of one drive that are not old enough look alike on a straight road,
forwards or backwards. And a reverse line that crosses the query's own best line shows the same place.
"""

from __future__ import annotations

import numpy as np

from loopclosure.lines.chance import oldest, settled_age
from loopclosure.methods.candidates import Candidates


def elsewhere(given: Candidates) -> tuple[np.ndarray, str]:
    """Return the pairs (Q, R) bool that certainly show different places unless the query has a loop, and a description.

    For two traverses these are all pairs. For one drive these are pairs at least as old, in frames, as the age at which
    the mean similarity of frames reaches its minimum.
    """
    if given.two:
        return given.allowed, ""
    age = floor_age(given.scores)
    numbers = np.arange(len(given.scores))
    old = np.subtract.outer(numbers, numbers) >= age
    return given.allowed & old, f"frames {age} apart are as dissimilar as different places"


def floor_age(scores: np.ndarray) -> int:
    """Return the smallest age, in frames, at which frames (N, N) of one drive differ as much as different places."""
    count = len(scores)
    means = [np.nanmean(np.diagonal(scores, -age)) if age < count else np.nan for age in range(1, oldest(count) + 1)]
    return settled_age(np.array(means), count)
