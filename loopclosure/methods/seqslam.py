"""SeqSLAM: places are recognized by sequences of images, not by single images (Milford and Wyeth, ICRA 2012).

All matrices are (Q, R), queries against references, each in the order of its traverse. Lower values are more similar,
except for the scores of the method at the end. It works on any matrix of distances: on SeqSLAM's own differences of
thumbnails, and on those of learned features ("seqslam+features:...").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from loopclosure.decision.trajectories import SequenceSettings, trajectory_costs
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.errors import InputError
from loopclosure.methods.base import BLOCK, Images, Method, MethodContext, MethodResult, earlier
from loopclosure.methods.baselines import ThumbnailMethod
from loopclosure.methods.settings import configure
from loopclosure.progress import Progress, timed

STANDARDIZE = ("no", "yes", "traverses")


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


def seqslam(settings: Mapping[str, str], context: MethodContext, inner: Method | None) -> SeqSlam:
    """Build ``seqslam`` on SeqSLAM's thumbnails, or ``seqslam+METHOD`` on another method's.

    Local contrast is SeqSLAM's own for its differences of thumbnails. For another method's scores the default is to
    standardize rows and columns, of two traverses, instead: better in another season on every sequence that it was
    chosen on (methods.md), and no change in one sequence, where either takes from good descriptors more than it gives.
    """
    own = Thumbnailer(width=64, height=32, normalize="patch", patch=8)
    if inner is not None:
        refined = SeqSlam(inner, standardize="traverses", exclude_frames=context.exclude_frames)
        method, sequences = configure("seqslam", settings, refined, SequenceSettings(contrast=0))
        return replace(method, settings=sequences, name=f"seqslam+{inner.name}")
    plain = SeqSlam(ThumbnailMethod(own), exclude_frames=context.exclude_frames)
    method, sequences, thumbnailer = configure("seqslam", settings, plain, SequenceSettings(), own)
    return replace(method, settings=sequences, inner=ThumbnailMethod(thumbnailer))
