"""From which score on lines tell loops from chance, and from which age on frames show different places."""

from __future__ import annotations

import numpy as np

TAIL = 0.1  # share of the decoys that the tail is fitted to, and at least so many:
LEAST_TAIL = 5
AGES = 100  # frames: the greatest age of a frame of the same visit
SETTLED = 0.05  # the remaining share of the fall from the similarity of neighbors to that of different places


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


def oldest(count: int) -> int:
    """Return the greatest age, in frames, of which a drive of ``count`` frames has enough pairs for a mean."""
    return max(1, count - max(5, count // 20) - 1)


def half_age(means: np.ndarray) -> int:
    """Return the age, in frames, at which half of the similarity has gone: so many in a row tell no more than one.

    means  (A,) the mean score of frames of one drive that are 1, 2, ... A apart; without any, 1
    """
    return int(np.flatnonzero(means <= (means[0] + means.min()) / 2)[0]) + 1 if len(means) else 1


def settled_age(means: np.ndarray, count: int) -> int:
    """Return the smallest age, in frames, at which ``count`` frames of a drive differ as much as different places.

    means  (A,) the mean score of frames that are 1, 2, ... A apart, NaN where not known

    There, only a share ``SETTLED`` of the fall of the mean score to its median over all ages remains.
    """
    if not np.isfinite(means).any():
        return 1
    floor = np.nanmedian(means)
    low = np.flatnonzero(means <= floor + SETTLED * (means[0] - floor))
    return int(low[0]) + 1 if len(low) else count
