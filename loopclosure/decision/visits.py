"""How alike frames of one drive are, and which places the camera has left: step 1 of the decision."""

from __future__ import annotations

import numpy as np

from loopclosure.decision.constants import AGES, AWAY, DRIFT, FAR_M, LENGTHS, SETTLED
from loopclosure.decision.growing import Growing
from netspec.files.opencv import cv2

AROUND = LENGTHS[-1] + 1  # frames around one, from whose scores its own stands out


class Usual:
    """How alike the frames of a drive are, so far or as a whole: of their scores with the frames before them."""

    def __init__(self) -> None:
        self._medians = Growing(2)  # of the scores of each frame, and their number
        self._sums = Growing(2)  # of the scores of frames so far apart, and their number
        self.visit: float | None = None  # how many frames a visit lasts; None: not known yet

    def add(self, scores: np.ndarray) -> None:
        """Add a frame by its scores (n,) with those of its drive before it, NaN where not known."""
        known = np.isfinite(scores)
        self._sums.append(np.zeros((2, 1)))
        if known.any():
            self._medians.append(np.array([[np.median(scores[known])], [known.sum()]]))
            self._sums.array[:, : len(scores)] += np.where(known, scores, 0)[::-1], known[::-1]

    def growing(self) -> dict[str, Growing]:
        """Return what a file must store to continue."""
        return {"medians": self._medians, "sums": self._sums}

    @property
    def score(self) -> float:
        """The score of different places: half of all pairs are no more alike."""
        if not len(self._medians):
            return np.nan
        medians, counts = self._medians.array[:, np.argsort(self._medians.array[0])]
        return float(medians[np.searchsorted(np.cumsum(counts), counts.sum() / 2)])

    def mean(self, ages: int) -> np.ndarray:
        """Return the mean score of frames that are 1, 2, ... ages apart, without those of which no pair is known."""
        total, number = self._sums.array[:, :ages]
        return total[number > 0] / number[number > 0]

    @property
    def age(self) -> int:
        """From which age on, in frames, frames differ as different places do.

        There, only a share ``SETTLED`` of the fall of the mean score to its median over all ages remains. Of the
        greatest ages there are too few pairs for a mean.
        """
        count = len(self._sums)
        means = self.mean(max(1, count - max(5, count // 20) - 1))
        if not len(means):
            return 1
        floor = np.median(means)
        low = np.flatnonzero(means <= floor + SETTLED * (means[0] - floor))
        return int(low[0]) + 1 if len(low) else count

    @property
    def together(self) -> int:
        """How many frames in a row tell no more than one: the age at which half of the similarity has gone."""
        means = self.mean(AGES)
        return int(np.flatnonzero(means <= (means[0] + means.min()) / 2)[0]) + 1 if len(means) else 1


class Visits:
    """Which places of a drive were left, frame after frame.

    A visit to the place of a frame ends with ``AWAY`` frames in a row that differ from it as different places do.
    Frames of a standing camera, or of a straight road, stay alike for long; that is no loop.
    """

    def __init__(self) -> None:
        self._seen = Growing(2)  # how many of the last frames differed from this one; the frames until it was left

    def growing(self) -> dict[str, Growing]:
        """Return what a file must store to continue."""
        return {"seen": self._seen}

    @property
    def usual(self) -> float:
        """How many frames a visit lasts, by the median; those that have not ended count as long as they last."""
        _, lasted = self._seen.array
        return float(np.median(np.where(lasted > 0, lasted, np.arange(len(lasted), 0, -1)))) if len(lasted) else 0.0

    def add(self, scores: np.ndarray, usual: float, least: float | None = None) -> np.ndarray:
        """Add a frame by its scores (n,) with those of its drive before it; return which of these may be its place.

        usual  the score of different places
        least  how many frames a visit lasts at least; None: as long as is usual so far
        """
        differs, lasted = self._seen.array
        count = len(scores)
        away = scores <= usual
        differs[:] = np.where(away, differs + 1, 0)
        ends = (differs >= AWAY) & (lasted == 0)
        lasted[ends] = count - np.flatnonzero(ends)
        # A turn of the road ends the visit of what was straight ahead within a second: no visit is shorter than usual.
        left = (lasted > 0) & (np.arange(count, 0, -1) > (self.usual if least is None else least))
        self._seen.append(np.zeros((2, 1)))
        run = np.flatnonzero(away[1:] & away[:-1])  # the visit of the new frame began after the last two that differ
        left[int(run[-1]) if len(run) else 0 :] = False
        return left


def outstanding(scores: np.ndarray) -> np.ndarray:
    """Return by how much each of a frame's scores (n,) stands out from those around: (x - mean) / deviation, float32.

    In another season or light all scores are lower. No deviation counts as less than the median of all: a black frame
    differs little from all others. NaN where the score is not known.
    """
    known = np.isfinite(scores)
    if not known.any():
        return np.full(len(scores), np.nan, np.float32)
    share = np.maximum(_around(known.astype(np.float64)), 1 / AROUND)
    values = np.where(known, scores - scores[known].mean(), 0)
    values = np.where(known, values - _around(values) / share, 0)
    deviations = np.sqrt(np.maximum(_around(np.square(values)), 0) / share)
    usual = max(float(np.median(deviations[known])), 1e-12)
    return np.where(known, values / np.maximum(deviations, usual), np.nan).astype(np.float32)


def _around(values: np.ndarray) -> np.ndarray:
    return cv2.blur(values[None], (AROUND, 1), borderType=cv2.BORDER_CONSTANT)[0]


def far_apart(poses: np.ndarray, frame: int) -> np.ndarray:
    """Return which frames (frame,) before one are far from it by odometry: poses (N, 7) in meters, NaN if not known."""
    positions = poses[: frame + 1, :3]
    known = np.all(np.isfinite(positions), axis=1)
    way = np.zeros(len(positions))
    way[known] = np.cumsum(np.linalg.norm(np.diff(positions[known], axis=0, prepend=positions[known][:1]), axis=1))
    apart = np.linalg.norm(positions[:-1] - positions[-1], axis=1)
    return apart > FAR_M + DRIFT * (way[-1] - way[:-1])  # False for NaN
