"""SeqSLAM: places are recognized by sequences of images, not by single images (Milford and Wyeth, ICRA 2012).

All matrices are (Q, R), queries against references, each in the order of its traverse. Lower values are more similar,
except for the scores of the method at the end. It works on any matrix of distances: on SeqSLAM's own differences of
thumbnails, and on those of learned features ("seqslam+features:...").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.errors import InputError
from loopclosure.methods.base import BLOCK, Images, Method, MethodContext, MethodResult, earlier
from loopclosure.methods.baselines import ThumbnailMethod
from loopclosure.methods.settings import configure
from loopclosure.progress import Progress, timed

DIRECTIONS = ("forward", "both")
ANCHORS = ("center", "start")
EDGES = ("shorten", "drop")
STANDARDIZE = ("no", "yes", "traverses")
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


def enhance_contrast(distances: np.ndarray, window: int = 10, valid: np.ndarray | None = None) -> np.ndarray:
    """Return (distance - mean) / deviation of each distance (Q, R), over its neighborhood among the references.

    The neighborhood is the references i - window/2 .. i + window/2 that exist and are ``valid`` (Q, R). The deviation
    is that with n - 1; if it is 0, so is the result. The least result is subtracted from all. Invalid pairs are NaN.
    """
    valid = np.ones(distances.shape, bool) if valid is None else valid
    if not valid.any():
        return np.full(distances.shape, np.nan)
    known = np.where(valid, distances, 0.0)
    count, mean, squares = (np.zeros(distances.shape) for _ in range(3))
    neighbors = list(_neighbors(distances.shape[1], window // 2))
    for here, there in neighbors:
        count[:, here] += valid[:, there]
        mean[:, here] += known[:, there]
    mean /= np.maximum(count, 1)
    for here, there in neighbors:
        squares[:, here] += np.where(valid[:, there], known[:, there] - mean[:, here], 0.0) ** 2
    deviation = np.sqrt(squares / np.maximum(count - 1, 1))
    differ = deviation > 1e-12 * np.abs(mean)  # rounding can make the deviation of equal distances slightly positive
    enhanced = np.divide(known - mean, deviation, out=np.zeros_like(known), where=differ)
    enhanced[~valid] = np.nan
    return enhanced - np.nanmin(enhanced)


def standardize(distances: np.ndarray, usual: bool = False) -> np.ndarray:
    """Give each row, then each column of distances (Q, R) mean 0 and deviation 1 over what is not NaN.

    A query that is unlike all references, and a reference that is like all queries, then count as any other: what
    another season does to descriptors. Memory is that of the result, in the precision of ``distances``.

    usual  no deviation counts as less than the median of all rows, or columns: a frame without a loop, or a black one,
           differs so little from all others that its small differences would look like loops
    """
    result = distances.copy()
    for along in (result, result.T):
        blocks = [along[first : first + BLOCK] for first in range(0, len(along), BLOCK)]
        deviations = np.concatenate([_centered(rows) for rows in blocks])
        if usual and np.isfinite(deviations).any():
            deviations = np.maximum(deviations, np.nanmedian(deviations))
        for first, rows in zip(range(0, len(along), BLOCK), blocks, strict=True):
            deviation = deviations[first : first + BLOCK, None]
            np.divide(rows, deviation, out=rows, where=deviation > 0)
    return result


def _centered(rows: np.ndarray) -> np.ndarray:
    """Subtract from rows (n, R) their means, in place, and return their deviations (n,), NaN where nothing is known."""
    known = np.isfinite(rows)
    count = known.sum(axis=1)
    mean = np.where(known, rows, 0).sum(axis=1) / np.maximum(count, 1)
    rows -= mean[:, None]
    deviation = np.sqrt(np.square(np.where(known, rows, 0)).sum(axis=1) / np.maximum(count, 1))
    rounding = deviation <= 1e-12 * np.abs(mean)  # see enhance_contrast
    rows[rounding] = np.where(known[rounding], 0, np.nan)
    return np.where(count > 0, np.where(rounding, 0.0, deviation), np.nan)


def _neighbors(size: int, reach: int) -> Sequence[tuple[slice, slice]]:
    """Return, for each shift up to ``reach``, the columns that have such a neighbor, and their neighbors."""
    shifts = range(-min(reach, size - 1), min(reach, size - 1) + 1)
    return [(slice(max(0, -s), size - max(0, s)), slice(max(0, s), size - max(0, -s))) for s in shifts]


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


def least_cost_matches(costs: np.ndarray, window: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Return each query's reference of least cost (Q,), -1 if there is none, and how unique it is (Q,).

    The second value is the ratio of that cost to the least cost more than ``window`` / 2 references away, in [0, 1];
    smaller is more certain (OpenSeqSLAM accepts below 0.9). It is NaN if one of the two costs does not exist.
    """
    finite = np.where(np.isnan(costs), np.inf, costs)
    match = np.argmin(finite, axis=1)
    rows = np.arange(len(costs))
    least = finite[rows, match]
    near = np.abs(np.arange(costs.shape[1])[None, :] - match[:, None]) <= window // 2
    rival = np.where(near, np.inf, finite).min(axis=1)
    judged = np.isfinite(least) & np.isfinite(rival)
    ratio = np.full(len(costs), np.nan)
    # Both are 0 if two references fit exactly: then neither is preferred.
    ratio[judged] = np.divide(least[judged], rival[judged], out=np.ones(judged.sum()), where=rival[judged] > 0)
    return np.where(np.isfinite(least), match, -1), ratio


@dataclass
class SeqSlam:
    """SeqSLAM on the scores of another method, its own thumbnails by default.

    scored          "cost": minus the cost of the best trajectory of each pair; "uniqueness": only each query's best
                    match gets a score, 1 - its ratio to the next best (see :func:`least_cost_matches`)
    match_window    of the uniqueness
    standardize     rows and columns of the distances before sequences are searched: "no", "yes", or "traverses": only
                    for two traverses, in which every query has a match. In one sequence most queries have none
    exclude_frames  in one sequence, references within this many frames of the query are not candidates
    """

    inner: Method
    settings: SequenceSettings = field(default_factory=SequenceSettings)
    scored: str = "cost"
    match_window: int = 10
    standardize: str = "no"
    exclude_frames: int = 0
    name: str = "seqslam"

    def __post_init__(self) -> None:
        if self.scored not in ("cost", "uniqueness"):
            raise InputError(f'SeqSLAM\'s score is "cost" or "uniqueness", not "{self.scored}"')
        if self.standardize not in STANDARDIZE:
            raise InputError(f'standardize of SeqSLAM is "{self.standardize}"; expected {", ".join(STANDARDIZE)}')

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says."""
        found = self.inner.score(images, progress)
        seconds = dict(found.seconds)
        with timed(seconds, "sequences"):
            valid = np.isfinite(found.scores)
            if images.references is None:
                valid &= earlier(len(images.queries), self.exclude_frames)
            distances = np.where(valid, -found.scores, np.nan)
            scaled = self.standardize == "yes" or (self.standardize == "traverses" and images.references is not None)
            if scaled:
                distances = standardize(distances)
            if self.settings.contrast:
                distances = enhance_contrast(distances, self.settings.contrast, valid)
            elif self.scored == "uniqueness":  # a ratio needs costs >= 0, and log-odds have no bound
                distances -= distances.min(where=valid, initial=0.0)
            costs = np.where(valid, trajectory_costs(distances, self.settings), np.nan)
            scores = -costs if self.scored == "cost" else self._unique(costs)
        scaling = "rows and columns of distances standardized; " if scaled else ""
        notes = [*found.notes, f"SeqSLAM, score: {self.scored}; {scaling}{self.settings}"]
        return MethodResult(scores, seconds, notes, found.training_stages)

    def _unique(self, costs: np.ndarray) -> np.ndarray:
        match, ratio = least_cost_matches(costs, self.match_window)
        scores = np.full(costs.shape, np.nan)
        judged = np.flatnonzero(np.isfinite(ratio))
        scores[judged, match[judged]] = 1.0 - ratio[judged]
        return scores


def seqslam(argument: str, context: MethodContext, inner: Method | None) -> SeqSlam:
    """Build ``seqslam[:setting=value,...]`` on SeqSLAM's thumbnails, or ``seqslam[:...]+METHOD`` on another method's.

    Local contrast is SeqSLAM's own for its differences of thumbnails. For another method's scores the default is to
    standardize rows and columns, of two traverses, instead: better in another season on every sequence that it was
    chosen on (methods.md), and no change in one sequence, where either takes from good descriptors more than it gives.
    """
    own = Thumbnailer(width=64, height=32, normalize="patch", patch=8)
    if inner is not None:
        refined = SeqSlam(inner, standardize="traverses", exclude_frames=context.exclude_frames)
        method, settings = configure("seqslam", argument, refined, SequenceSettings(contrast=0))
        return replace(method, settings=settings, name=f"seqslam+{inner.name}")
    method, settings, thumbnailer = configure(
        "seqslam",
        argument,
        SeqSlam(ThumbnailMethod(own), exclude_frames=context.exclude_frames),
        SequenceSettings(),
        own,
    )
    return replace(method, settings=settings, inner=ThumbnailMethod(thumbnailer))
