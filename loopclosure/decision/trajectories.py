"""Straight trajectories through a matrix of distances, and the least mean distance along any of them.

All matrices are (Q, R), queries against references, each in the order of its traverse. Lower values are more similar.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from loopclosure.errors import InputError

DIRECTIONS = ("forward", "both")
ANCHORS = ("center", "start")
EDGES = ("shorten", "drop")
TILE = 128, 512  # pairs whose sums stay in the cache
SEGMENT = 4  # steps of a trajectory, which other trajectories may share
LONGEST = 10_000  # frames in a sequence; memory grows with it


@dataclass(frozen=True)
class SequenceSettings:
    """How sequences are searched; lengths, windows and velocities are OpenSeqSLAM's.

    length         steps of a trajectory (it has length + 1 images), half of them before the query, half after
    slowest        least velocity, in reference frames per query frame
    fastest        greatest velocity
    velocity_step  step between velocities
    contrast       local contrast: references i - contrast/2 .. i + contrast/2 are the neighborhood; 0: none
    directions     "forward", or "both": the references may also be passed in reverse order
    anchor         the reference that a trajectory belongs to: its "center", or, as in OpenSeqSLAM, "start" + length/2
    edges          if a trajectory leaves the matrix: "drop" it (OpenSeqSLAM), or "shorten" it, to no less than half
    """

    length: int = 10
    slowest: float = 0.8
    fastest: float = 1.2
    velocity_step: float = 0.1
    contrast: int = 10
    directions: str = "forward"
    anchor: str = "center"
    edges: str = "shorten"

    def __post_init__(self) -> None:
        for name, choices in {"directions": DIRECTIONS, "anchor": ANCHORS, "edges": EDGES}.items():
            if (value := getattr(self, name)) not in choices:
                raise InputError(f'{name} of SeqSLAM is "{value}"; expected {" or ".join(choices)}')
        if not 1 <= self.length <= LONGEST or self.contrast < 0:
            expected = f"length 1 to {LONGEST} and contrast >= 0"
            raise InputError(f"SeqSLAM needs {expected}, got {self.length} and {self.contrast}")
        if not 0.0 < self.slowest <= self.fastest or self.velocity_step <= 0.0:
            raise InputError(
                f"SeqSLAM needs 0 < slowest <= fastest and a positive step, got {self.slowest:g}, {self.fastest:g}, "
                f"{self.velocity_step:g}"
            )

    @property
    def velocities(self) -> np.ndarray:
        """The velocities that are tried, in reference frames per query frame."""
        steps = int((self.fastest - self.slowest) / self.velocity_step + 1e-9)
        return self.slowest + self.velocity_step * np.arange(steps + 1)

    def offsets(self) -> np.ndarray:
        """Return the reference that each trajectory passes at each step, relative to its own: (T, length + 1)."""
        steps = np.arange(self.length + 1)
        half = self.length // 2
        # The small term is for products such as 1.2 * 5, which is just below 6 in binary.
        if self.anchor == "start":
            paths = np.floor(np.outer(self.velocities, steps) + 1e-9).astype(int) - half
        else:
            paths = np.rint(np.outer(self.velocities, steps - half)).astype(int)
        if self.directions == "both":
            paths = np.concatenate([paths, -paths])
        return np.unique(paths, axis=0)


def trajectory_costs(distances: np.ndarray, settings: SequenceSettings, rows: range | None = None) -> np.ndarray:
    """Return the least mean distance along any trajectory through each query and reference: (Q, R).

    NaN in ``distances`` (Q, R) counts as outside the matrix. A cost is NaN if too little of every trajectory is inside.
    ``rows``: only of these queries. Costs have the precision of the distances.
    """
    queries, references = distances.shape
    rows = range(queries) if rows is None else rows
    half = settings.length // 2
    offsets = settings.offsets()
    reach = int(np.abs(offsets).max())
    needed = settings.length + 1 if settings.edges == "drop" else half + 1
    margins = ((half, settings.length - half), (reach, reach))
    known = np.isfinite(distances)
    inside = np.pad(known, margins)
    padded = np.pad(np.where(known, distances, distances.dtype.type(0)), margins)
    costs = np.full((len(rows), references), np.nan, distances.dtype)
    for top, left in product(range(0, len(rows), TILE[0]), range(0, references, TILE[1])):
        tile = costs[top : top + TILE[0], left : left + TILE[1]]
        above = top + rows.start
        around = np.s_[above : above + len(tile) + settings.length, left : left + tile.shape[1] + 2 * reach]
        if inside[around].any():
            _tile_costs(padded[around], inside[around], offsets + reach, needed, tile)
    return costs


def _tile_costs(padded: np.ndarray, inside: np.ndarray, offsets: np.ndarray, needed: int, costs: np.ndarray) -> None:
    """Write the costs of some pairs, of which ``padded`` and ``inside`` hold the surroundings, into ``costs``."""
    best, whole, (height, width), steps = np.full_like(costs, np.inf), inside.all(), costs.shape, offsets.shape[1]
    mean, count = np.empty_like(costs), np.full(costs.shape, steps, np.min_scalar_type(steps))
    sums = [(mean, {(0,): padded}), (count, {(0,): inside.view(np.uint8)})][: 1 if whole else 2]
    for path in offsets.tolist():
        for total, made in sums:
            total[:] = 0
            for step in range(0, steps, SEGMENT):
                left = min(path[step : step + SEGMENT])
                part = _sums(made, tuple(shift - left for shift in path[step : step + SEGMENT]))
                total += part[step : step + height, left : left + width]
        outside = count < needed
        mean /= np.maximum(count, 1)
        np.copyto(mean, np.inf, where=outside)
        np.minimum(best, mean, out=best)
    np.copyto(costs, best, where=np.isfinite(best))


def _sums(made: dict[tuple[int, ...], np.ndarray], shifts: tuple[int, ...]) -> np.ndarray:
    """Return the sums along part of a trajectory from each pair: fewer rows and columns than ``made[0,]``, the values.

    shifts  the columns by which it is shifted in each row, the least 0
    made    the sums so far: parts are shared by many trajectories
    """
    if shifts not in made:
        half, rows, columns = len(shifts) // 2, len(made[0,]) - len(shifts) + 1, made[0,].shape[1] - max(shifts)
        ends = [(row, part, min(part)) for row, part in ((0, shifts[:half]), (half, shifts[half:]))]
        a, b = (_sums(made, tuple(s - x for s in part))[row:, x:][:rows, :columns] for row, part, x in ends)
        made[shifts] = a + b
    return made[shifts]
