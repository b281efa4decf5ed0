"""The decision on sequences: the line through a frame, the stretch of matches that it continues, and their points."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from loopclosure.detector.decision import LoopResult
from loopclosure.detector.frames import Frames
from loopclosure.detector.images import ImageDecision
from loopclosure.detector.lines import HALF, Line, OnlineLines
from loopclosure.detector.verification import Agreement, GeometricCheck
from loopclosure.lines.course import on_course
from loopclosure.lines.points import in_part, too_few


@dataclass(frozen=True)
class Seen:
    """A match of a stretch, and what its points say.

    evidence  inliers divided by the number needed
    whole     whether most points that match agree
    visit     the evidence of the query and an earlier frame of its visit that is no more similar; None without one
    """

    query: int
    match: int
    evidence: float
    whole: bool
    visit: float | None


class Sequences:
    """Decides on the frame that is ``HALF`` frames old, by the line through it and the stretch that this continues."""

    def __init__(self, images: ImageDecision, frames: Frames) -> None:
        self.lines = OnlineLines()
        self._images, self._frames = images, frames
        self._stretch: list[Seen] = []
        self._backwards = False

    def begin_session(self, count: int) -> None:
        """Start another drive after ``count`` frames."""
        self.lines.begin_session(count)
        self._stretch = []

    def add(self, scores: np.ndarray, end: int, by_visit: bool) -> LoopResult | None:
        """Add the newest stored frame, see :meth:`OnlineLines.add`; return the loop of an earlier one."""
        line, check = self.lines.add(scores, end, by_visit), self._images.check
        if self._images.settings.threshold is not None or check is None or line is None or not line.accepted:
            return None
        found = self._continue(line, check)
        if not self._is_loop():
            return None
        stamp = float(self._frames.stamps[line.query])
        return LoopResult(
            line.query,
            [(line.match, line.score)],
            line.match,
            "accepted",
            line.score,
            check.enough(found),
            None if np.isnan(stamp) else stamp,
            f"sequence: {line.score:.2f}, the next best {line.other:.2f}",
            "sequence",
        )

    def _continue(self, line: Line, check: GeometricCheck) -> Agreement:
        """Add an accepted line to the stretch, which begins anew if the line does not continue it."""
        last = self._stretch[-1] if self._stretch else None
        way = line.query - last.query if last else 0
        continues = last is not None and way <= HALF and line.course.backwards == self._backwards
        if last is None or not continues or not on_course(line.match - last.match, way, line.course):
            self._stretch, self._backwards = [], line.course.backwards
        local, points, of_visit = self._frames.local, self._images.points, self.lines.as_similar(line)
        found, visit = check.agreement(local[line.query], local[line.match]), None
        if of_visit is not None:
            visit = check.evidence(check.agreement(local[line.query], local[of_visit]), points)
        self._stretch.append(Seen(line.query, line.match, check.evidence(found, points), found.whole, visit))
        return found

    def _is_loop(self) -> bool:
        """Return whether the newest match is a loop: of enough on the stretch, and no points speak against it."""
        verified = [each for each in self._stretch if each.evidence >= 1]
        sure = any(each.whole and each.evidence >= self._images.asked for each in verified)
        if len(self._stretch) < 2 * HALF and not sure:
            return False
        if in_part(len(verified), sum(each.whole for each in verified)):
            return False
        visits = [each.visit for each in self._stretch if each.visit is not None]
        one = sum(each >= 1 for each in visits), len(visits)
        found = len(verified), len(self._stretch)
        return not too_few(found, self.lines.together, one, self._images.same_points)

    def stretch(self) -> dict[str, Any]:
        """Return what a file stores beside the arrays of the lines."""
        return {"backwards": self._backwards, "seen": [asdict(each) for each in self._stretch]}

    def take(self, arrays: dict[str, Any], stretch: dict[str, Any]) -> None:
        """Continue from a file. Raises LookupError, TypeError or ValueError if it does not fit."""
        self.lines.take(arrays)
        self._backwards, self._stretch = bool(stretch["backwards"]), [Seen(**each) for each in stretch["seen"]]
