"""The decision on a single image: its score, then its points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopclosure.detector.decision import DetectorSettings, LoopResult, Runs
from loopclosure.detector.frames import Frames
from loopclosure.detector.verification import GeometricCheck, LocalFeatures
from loopclosure.lines.points import SURE, Share, asked, look_alike

UNLIKE = 40  # frames, each of which is compared with an unlike one; then every second frame is, and so on
AMONG = 9  # frames of which the least similar one is unlike
LEAST_STEPS = 20  # scores of consecutive frames that are needed to choose a threshold
PART = "enough points agree, but only a part of those that match"
ALIKE = "places may look alike: until enough frames agree with their match as a whole, more points must agree"
VISIT = "the place was not left in between"


def always(frame: int) -> bool:
    """Return True: the place of a frame of another drive was left."""
    return True


class ImageDecision:
    """Decides on images one by one, and knows what was learned from the frames so far.

    steps   the score of each frame with the one before it
    unlike  the scores of unlike pairs of frames, and their points in common
    agreed  how many frames with enough points agree with their match as a whole, and how many only in part
    """

    def __init__(self, settings: DetectorSettings, check: GeometricCheck | None, frames: Frames) -> None:
        self.settings, self.check = settings, check
        self.steps: list[float] = []
        self.unlike: list[tuple[float, int]] = []
        self.agreed = [0, 0]
        self._frames = frames

    def threshold(self) -> float | None:
        """Return the current threshold; None if there are too few frames to choose one."""
        if self.settings.threshold is not None:
            return self.settings.threshold
        if self.check is not None:
            return -np.inf
        return float(np.median(self.steps)) if len(self.steps) >= LEAST_STEPS else None

    def decide(
        self,
        found: LoopResult,
        local: LocalFeatures | None,
        before: Runs,
        left: Callable[[int], bool] = always,
    ) -> tuple[LoopResult, Runs]:
        """Apply threshold, consistency, then geometry; return the result and the runs for the next frame.

        found   the query, its candidates and its stamp
        local   its points
        before  the runs of the frame before it
        left    whether the place of a frame was left before the query
        """
        settings, candidates = self.settings, found.candidates
        runs: Runs = []

        def result(
            verdict: str,
            accepted: int | None = None,
            value: float = found.score,
            inliers: int | None = None,
            reason: str = "",
        ) -> tuple[LoopResult, Runs]:
            return LoopResult(found.query_id, candidates, accepted, verdict, value, inliers, found.stamp, reason), runs

        if not candidates:
            return result("no candidate")
        threshold = self.threshold()
        if threshold is None:
            return result("too early")
        likely = [(number, value) for number, value in candidates if value >= threshold]
        if not likely:
            return result("below threshold")
        for number, _ in likely:
            led = [run for other, run in before if abs(other - number) <= settings.consistency_window]
            runs.append((number, 1 + max(led, default=0)))
        steady = [pair for pair, (_, run) in zip(likely, runs, strict=True) if run > settings.consistency]
        if not steady:
            return result("not consistent")
        if self.check is None:
            return result("accepted", *steady[0])
        assert local is not None
        most, reason = 0, ""
        for number, value in steady:
            agreement = self.check.agreement(local, self._frames.local[number])
            if inliers := self.check.sure(agreement, self.points):
                if not left(number):
                    most, reason = inliers, VISIT
                    continue
                if not self.check.sure(agreement, self.points, self.asked):
                    return result("not verified", inliers=inliers, reason=ALIKE)
                return result("accepted", number, value, inliers)
            most = max(most, agreement.inliers)
            if self.check.evidence(agreement, self.points) >= SURE:
                reason = PART
        return result("not verified", inliers=most, reason=reason)

    def learn(self, result: LoopResult, row: np.ndarray, local: LocalFeatures | None) -> None:
        """Note the result of a frame (views, D) that is stored, and compare it with an unlike one.

        The unlike one is the least similar of some earlier ones: a bridge's towers are seen all along.
        """
        self.agreed[0] += result.accepted is not None or result.reason == ALIKE
        self.agreed[1] += result.reason == PART
        frames, last = self._frames, result.query_id
        if self.check is None or local is None or last < LEAST_STEPS or last % (1 + len(self.unlike) // UNLIKE):
            return
        some = np.linspace(0, last - 1, AMONG).round().astype(int).tolist()
        scores = [frames.score(frames.rows(number, number + 1).reshape(row.shape), row) for number in some]
        least = some[int(np.argmin(scores))]
        self.unlike.append((min(scores), self.check.enough(self.check.agreement(local, frames.local[least]))))

    @property
    def asked(self) -> float:
        """The evidence that an image needs by now."""
        return asked(look_alike(self.agreed[1], sum(self.agreed)))

    @property
    def _least_alike(self) -> list[int]:
        """The points in common of the less similar half of the unlike pairs: at the start no frame is unlike."""
        return [points for _, points in sorted(self.unlike)[: (len(self.unlike) + 1) // 2]]

    @property
    def points(self) -> float:
        """The mean number of points that unlike pairs have in common, of those below their own number needed 0."""
        return sum(self._least_alike) / max(1, len(self._least_alike))

    @property
    def same_points(self) -> Share:
        """How many unlike pairs show the same points, and of how many."""
        return sum(map(bool, self._least_alike)), len(self._least_alike)
