"""Looking up the frames of another session in a detector, without adding them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopclosure.decision.decider import Decider
from loopclosure.detector.decision import LoopResult, Runs
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.verification import Agreement, GeometricCheck
from loopclosure.errors import InputError


class Visitor:
    """Looks up the frames of one session, in order; all frames of the detector are candidates.

    The ``query`` of its results counts its own frames from 0. Several visitors, also in several threads, can use one
    detector as long as nothing is added to it. ``newest`` is the result of the newest frame, a loop or not.
    """

    newest: LoopResult

    def __init__(self, detector: LoopDetector) -> None:
        self.detector = detector
        self._count = 0
        self._runs: Runs = []
        check = detector.check
        self._decider, self._local = None, None
        if check is not None:
            self._decider = Decider(check=check, agree=self._agreement)

    def _agreement(self, _: int, frame: int) -> Agreement:
        check, local = self.detector.check, self._local
        assert check is not None, "only a detector with a check compares points"
        assert local is not None
        return check.agreement(local, self.detector.local_features(frame))

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
    ) -> list[LoopResult]:
        """Look up this session's next frame, (H, W, 3) uint8 BGR; the ``match`` of a loop is one of the detector."""
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
    ) -> list[LoopResult]:
        """Look up a frame by its descriptor (D,); ``pose`` and ``odometry`` are not used."""
        if self.check is not None:
            if image is None:
                raise InputError("a geometric check needs the images")
            self._local = self.check.describe(image)
        self.newest, self._runs = self.detector.looked_up(self._count, descriptor, stamp, self._runs, self._decider)
        self._count += 1
        return [self.newest] if self.newest else []
