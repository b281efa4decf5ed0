"""The result of adding a frame to a detector, and the settings of the decision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopclosure.decision.constants import RECENT
from loopclosure.descriptors.similarity import check_metric
from loopclosure.errors import InputError

Runs = list[tuple[int, int]]  # of one frame: (candidate, number of consecutive frames that led to it)


@dataclass(frozen=True)
class LoopResult:
    """What was decided about one frame. It is true if the frame closes a loop.

    query       the frame's number, from 0
    candidates  (number, score) of the best earlier frames, best first, higher = more similar
    match       the earlier frame that this one closes a loop with, or None
    verdict     the reason: "accepted", "no candidate", "too early" (to choose a threshold), "below threshold",
                "not consistent", "not verified"
    score       of the accepted frame, or of the best candidate; -inf without one
    inliers     inliers of the accepted candidate, or the most of any candidate tried; None if none was tried
    stamp       seconds, as given
    score_of    what the score compares: "image", or the "sequence" of frames around it; they are different scales
    reason      what decided: the sequence of the frame or its points; empty where the verdict says all
    wrong       the share of wrong ones that is expected among loops as good, None where that is not known
    """

    query: int
    candidates: list[tuple[int, float]]
    match: int | None
    verdict: str
    score: float
    inliers: int | None = None
    stamp: float | None = None
    reason: str = ""
    score_of: str = "image"
    wrong: float | None = None

    def __bool__(self) -> bool:
        return self.match is not None


@dataclass(frozen=True)
class DetectorSettings:
    """How loops are decided.

    metric              "euclidean" (score = minus the distance) or "cosine"
    views               the number of views of an image in a descriptor, one after the other; the score of two
                        frames is the score of their two most similar views
    exclude_recent      frames i - exclude_recent .. i - 1 are not candidates of frame i. None: 0 if exclude_seconds
                        is given, else 20. Unless it is given, the geometric check accepts no frame whose place the
                        camera has not left since
    exclude_seconds     frames less than this many seconds old are not candidates either
    top_k               how many candidates are examined
    threshold           a candidate needs score >= threshold. None: the geometric check decides alone; without a check,
                        the threshold is the median score of consecutive frames so far
    consistency         the number of previous frames that must have had a candidate that leads to this one: the frames
                        of a true loop follow each other
    consistency_window  a candidate leads to a candidate of the next frame if they are at most this many frames apart
    """

    metric: str = "euclidean"
    views: int = 1
    exclude_recent: int | None = None
    exclude_seconds: float = 0.0
    top_k: int = 5
    threshold: float | None = None
    consistency: int = 0
    consistency_window: int = 5

    def __post_init__(self) -> None:
        check_metric(self.metric)
        for name in ("views", "top_k", "exclude_recent", "exclude_seconds", "consistency"):
            least = int(name in ("views", "top_k"))
            if (value := getattr(self, name)) is not None and value < least:
                raise InputError(f"{name} is {value}; expected {least} or more")
        if self.threshold is not None and np.isnan(self.threshold):
            raise InputError("threshold is nan; expected a number")
        if self.consistency_window < 0:
            raise InputError(f"consistency_window is {self.consistency_window}; expected 0 or more")

    @property
    def recent(self) -> int:
        """How many frames before a frame are not its candidates, whatever their age in seconds."""
        if self.exclude_recent is not None:
            return self.exclude_recent
        return 0 if self.exclude_seconds else RECENT


def result_of(found: Any, count: int) -> LoopResult:
    """Return a loop read from a file of ``count`` frames. Raises ValueError, LookupError or TypeError."""
    candidates = [(int(number), float(score)) for number, score in found["candidates"]]
    words = {name: str(found[name]) for name in ("reason", "score_of") if name in found}
    loop = LoopResult(**{**found, "candidates": candidates, **words})
    ends = (loop.query, loop.match)
    if not all(isinstance(end, int) and 0 <= end < count for end in ends) or not isinstance(loop.score, float):
        raise ValueError(f"a loop of frames {ends} among {count}")
    if (
        not isinstance(loop.wrong, float | None)
        or not isinstance(loop.inliers, int | None)
        or not isinstance(loop.stamp, float | int | None)
    ):
        raise ValueError(f"a loop with {loop.inliers!r:.20} inliers at {loop.stamp!r:.20} s")
    return loop
