"""Which candidates of a frame are likely by their scores: those above a threshold that continue those before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from loopclosure.detector.decision import DetectorSettings, Runs

LEAST_STEPS = 20  # scores of consecutive frames that are needed to choose a threshold
Scored = Sequence[tuple[int, float]]


@dataclass
class Likely:
    """The rules of the settings; ``steps`` are the scores of each frame with the one before it."""

    settings: DetectorSettings
    steps: list[float] = field(default_factory=list)

    def threshold(self, checked: bool) -> float | None:
        """Return the current threshold; None if there are too few frames to choose one. ``checked``: by points."""
        if self.settings.threshold is not None:
            return self.settings.threshold
        if checked:
            return -np.inf
        return float(np.median(self.steps)) if len(self.steps) >= LEAST_STEPS else None

    def of(self, candidates: Scored, before: Runs, checked: bool) -> tuple[str, Scored, Runs]:
        """Return the verdict on a frame if there are none, its likely candidates, and its runs for the next frame."""
        settings, threshold = self.settings, self.threshold(checked)
        if not candidates:
            return "no candidate", [], []
        if threshold is None:
            return "too early", [], []
        likely, runs = [(number, score) for number, score in candidates if score >= threshold], Runs()
        for number, _ in likely:
            led = [run for other, run in before if abs(other - number) <= settings.consistency_window]
            runs.append((number, 1 + max(led, default=0)))
        steady = [pair for pair, (_, run) in zip(likely, runs, strict=True) if run > settings.consistency]
        return "not consistent" if likely else "below threshold", steady, runs
