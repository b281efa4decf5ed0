"""From which score on lines tell loops from chance."""

from __future__ import annotations

import numpy as np

TAIL = 0.1  # share of the decoys that the tail is fitted to, and at least so many:
LEAST_TAIL = 5


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
