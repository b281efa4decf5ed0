"""A quantity over the iterations of a training."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np

_POINTS_OF_WINDOW = 25  # a curve is smoothed over this part of its points
_USUAL, _MANY = 98, 20  # percent of the values that are not left out of a drawing, where there are so many


@dataclass
class Curve:
    """Values at iterations, which increase."""

    iterations: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.values)

    def add(self, iteration: int, value: float) -> None:
        """Add a value; it replaces those of this and of later iterations."""
        self.cut(iteration)
        self.iterations.append(iteration)
        self.values.append(value)

    def cut(self, iteration: int) -> None:
        """Remove the values from an iteration on: a training was resumed there."""
        if self.iterations and self.iterations[-1] >= iteration:
            end = bisect_left(self.iterations, iteration)
            del self.iterations[end:], self.values[end:]

    @property
    def last(self) -> float | None:
        """The last value, if there is any."""
        return self.values[-1] if self.values else None

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return iterations and values, float64 (n,)."""
        return np.array(self.iterations, float), np.array(self.values, float)


def smoothed(values: np.ndarray, window: int | None = None) -> np.ndarray:
    """Return the mean of the ``window`` values around each value (n,); near the ends of those that are there.

    NaN and infinity are left out; where nothing is left, the mean is NaN. Without a window a 25th of the values is
    taken.
    """
    size = max(1, len(values) // _POINTS_OF_WINDOW) if window is None else min(window, 2 * len(values))
    half = size // 2
    known = np.isfinite(values)
    sums = np.concatenate([[0.0], np.cumsum(np.where(known, values, 0.0))])
    counts = np.concatenate([[0], np.cumsum(known)])
    places = np.arange(len(values))
    low, high = np.maximum(places - half, 0), np.minimum(places + half + 1, len(values))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (sums[high] - sums[low]) / (counts[high] - counts[low])


def thinned(x: np.ndarray, y: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most about ``most`` of the points (n,): of each stretch the least and the greatest value."""
    if len(x) <= most:
        return x, y
    keep: set[int] = {0, len(x) - 1}
    for part in np.array_split(np.arange(len(x)), max(1, most // 2)):
        finite = part[np.isfinite(y[part])]
        if len(finite):
            keep |= {int(finite[np.argmin(y[finite])]), int(finite[np.argmax(y[finite])])}
    chosen = sorted(keep)
    return x[chosen], y[chosen]


def shown_range(curves: list[np.ndarray]) -> tuple[float, float] | None:
    """Return the least and the greatest value to draw of curves (n,); None where no value is finite.

    A few values of a curve far above the rest, which a loss often has at its start, are left out.
    """
    finite = [values[np.isfinite(values)] for values in curves]
    finite = [values for values in finite if len(values)]
    if not finite:
        return None
    low = min(float(values.min()) for values in finite)
    most = max(float(values.max()) for values in finite)
    usual = max(float(np.percentile(values, _USUAL if len(values) >= _MANY else 100)) for values in finite)
    high = low + 1.6 * (usual - low)
    return (low, high) if most > low + 3 * (usual - low) > low else (low, most)
