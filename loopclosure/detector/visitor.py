"""Looking up the frames of another session in a detector, without adding them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopclosure.detector.decision import LoopResult, Runs
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError


class Visitor:
    """Looks up the frames of one session, in order; all frames of the detector are candidates.

    The ``query_id`` of its results counts its own frames from 0. Several visitors, also in several threads, can use one
    detector as long as nothing is added to it.
    """

    def __init__(self, detector: LoopDetector) -> None:
        self.detector = detector
        self._count = 0
        self._runs: Runs = []

    @property
    def check(self) -> GeometricCheck | None:
        """The geometric check of the detector."""
        return self.detector.check

    def add(
        self,
        image: np.ndarray,
        stamp: float | None = None,
        pose: Sequence[float] | np.ndarray | None = None,
        odometry: Sequence[float] | np.ndarray | None = None,
    ) -> LoopResult:
        """Look up this session's next frame, (H, W, 3) uint8 BGR; ``accepted`` is a frame of the detector."""
        if self.detector.describe is None:
            raise InputError("this detector has no describe function; give one, or use add_descriptor")
        return self.add_descriptor(self.detector.describe(image), stamp, pose, image, odometry)

    def add_descriptor(
        self,
        descriptor: Sequence[float] | np.ndarray,
        stamp: float | None = None,
        pose: Sequence[float] | np.ndarray | None = None,
        image: np.ndarray | None = None,
        odometry: Sequence[float] | np.ndarray | None = None,
    ) -> LoopResult:
        """Look up a frame by its descriptor (D,); ``pose`` and ``odometry`` are not used."""
        result, self._runs = self.detector.looked_up(self._count, descriptor, stamp, image, self._runs)
        self._count += 1
        return result
