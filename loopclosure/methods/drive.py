"""The loops of a whole drive: what ``loopclosure detect``, ``map`` and ``auto+METHOD`` find."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopclosure.decision.constants import PRECISION, RECENT, SPEEDS, VELOCITIES
from loopclosure.decision.decider import Agree, Decider, Decision, Settings
from loopclosure.decision.lines import HALF, courses
from loopclosure.decision.reasons import all_of
from loopclosure.decision.visits import Usual, Visits, far_apart
from loopclosure.descriptors.feature_file import Features
from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.detector.answered import results_of
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.run import remember_all
from loopclosure.detector.verification import GeometricCheck, Pairs
from loopclosure.errors import InputError
from loopclosure.places.frames import gray, read_gray
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.progress import Progress, silent

BLOCK = 256  # queries that are compared at a time, which limits the memory
NOTHING = np.zeros((8, 8), np.uint8)


@dataclass(frozen=True)
class Request:
    """The settings of a decision on a whole drive.

    precision  the share of the accepted loops that should be right
    recent     how many frames a visit to a place lasts; None: found from the scores, and at least ``RECENT``
    seconds    the minimum duration of a visit
    odometry   poses (frames, 7), NaN if not known; frames that are far apart by these are not a loop
    """

    precision: float = PRECISION
    recent: int | None = None
    seconds: float = 0.0
    odometry: np.ndarray | None = None

    def possible(self, query: int, stamps: np.ndarray) -> np.ndarray:
        """Return which frames (query,) of a drive with these stamps (frames,) may be the place of one of them."""
        recent = RECENT if self.recent is None and not self.seconds else self.recent or 0
        found = np.arange(query) < query - recent
        if self.seconds:
            found &= stamps[:query] <= stamps[query] - self.seconds
        return found if self.odometry is None else found & ~far_apart(self.odometry, query)


@dataclass(frozen=True)
class Drive:
    """The queries of a drive, and the references they are compared with.

    count     queries
    block     a function: the scores (n, R) of some queries with all references, and (n, count) with all queries
    begin     the first reference that is a query, which are the last references; None: none is
    possible  a function: which references (R,) may be the place of a query; R are those before it in one drive
    speeds    references for a query, tried one group after the other until one finds loops
    visits    whether the camera must have left a place before it can come back to it
    """

    count: int
    block: Callable[[range], tuple[np.ndarray, np.ndarray]]
    begin: int | None
    possible: Callable[[int], np.ndarray] | None = None
    speeds: Sequence[Sequence[float]] = ((1.0,),)
    visits: bool = True

    def rows(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield each query, its scores with the references that may be compared, and those with the queries before."""
        for first in range(0, self.count, BLOCK):
            rows = range(first, min(first + BLOCK, self.count))
            for query, scores, own in zip(rows, *self.block(rows), strict=True):
                yield query, scores if self.begin is None else scores[: self.begin + query], own[:query]

    def usual(self) -> Usual:
        """Return what the drive as a whole says about visits."""
        usual, visits = Usual(), Visits()
        for _, _, own in self.rows():
            usual.add(own)
        score = usual.score
        for _, _, own in self.rows():
            visits.add(own, score)
        usual.visit = visits.usual
        return usual

    def decided(
        self,
        precision: float,
        check: GeometricCheck | None = None,
        agree: Agree | None = None,
        among: Agree | None = None,
        progress: Progress = silent,
    ) -> tuple[Decider, Decision]:
        """Decide on all queries."""
        usual, begin = self.usual(), self.begin if self.visits else None
        for speeds in self.speeds:
            decider = Decider(Settings(precision, tuple(courses(speeds))), check, agree, among, usual)
            for query, scores, own in progress(self.rows(), "looking for loops", self.count):
                decider.add(scores, own, begin, self.possible and self.possible(query))
                decider.look(query)
                if query % BLOCK == BLOCK - 1:
                    decider.lines.search(query + 1 - HALF)
            decider.lines.search(self.count)
            decision = decider.decide(0, self.count)
            if decision.by_line.any():
                break
        return decider, decision


def speeds_between(queries: int, references: int) -> list[Sequence[float]]:
    """Return the speeds of two traverses: the usual one, that of their lengths, and others.

    One may be a part of the other: the ratio of their lengths is the speed only if both cover the whole route.
    """
    whole, (slowest, fastest, _) = references / max(1, queries), VELOCITIES
    return [(1.0,) if slowest <= whole <= fastest else (whole, 1.0), SPEEDS]


@dataclass(frozen=True)
class Answer:
    """What became of each query, and sentences that say what was chosen and why."""

    results: list[LoopResult]
    reasons: list[str]

    @property
    def match(self) -> np.ndarray:
        """Each query's best reference (Q,), accepted or not, -1 without one."""
        return np.array([result.candidates[0][0] if result.candidates else -1 for result in self.results], int)

    @property
    def accepted(self) -> np.ndarray:
        """Which queries (Q,) close a loop with their match."""
        return np.array([bool(result) for result in self.results], bool)


USUAL = Request()


def whole_drive(
    detector: LoopDetector,
    recording: ImageSequence,
    features: Features | None = None,
    request: Request = USUAL,
    progress: Progress = silent,
) -> Answer:
    """Add every frame of a recording to a new detector, then decide from all of them which ones close loops.

    ``request.seconds`` is set from the detector's settings. The loops are stored in the detector.
    """
    remember_all(detector, recording, features, progress)
    request = replace(request, seconds=detector.settings.exclude_seconds)
    if recording.unreadable and request.odometry is not None:
        request = replace(request, odometry=np.delete(request.odometry, recording.unreadable, axis=0))
    recording = recording.readable()
    check, pairs = detector.check or GeometricCheck(), Pairs(lambda number: _gray_image(recording, number))
    if detector.check is not None:
        pairs = Pairs(detector.local_features)
    elif not recording.paths:  # frames that cannot be read later
        frames = progress(recording.frames(), "local features", len(recording))
        pairs = Pairs({number: check.describe(gray(image)) for number, image, _ in frames}.__getitem__)
    found = _session(detector, True, request, check, pairs, progress)
    detector.decided([result for result in found.results if result])
    return found


def last_session(
    detector: LoopDetector, own: bool = True, request: Request = USUAL, progress: Progress = silent
) -> Answer:
    """Decide on the last session of a detector, from all of its frames.

    It is compared with the sessions before it and, if ``own``, with itself. Without a geometric check, each frame is
    looked up by itself.
    """
    begin, count = detector.sessions[-1], len(detector)
    if detector.check is None or begin == count:
        results = [detector.look_up(frame) for frame in progress(range(begin, count), "looking up", count - begin)]
        return Answer(results, ["nothing can be verified: decided frame by frame"])
    return _session(detector, own, request, detector.check, Pairs(detector.local_features), progress)


def _session(
    detector: LoopDetector, own: bool, request: Request, check: GeometricCheck, pairs: Pairs, progress: Progress
) -> Answer:
    begin, count, settings = detector.sessions[-1], len(detector), detector.settings
    known, stamps = detector.descriptors, detector.stamps[begin:]

    def block(queries: range) -> tuple[np.ndarray, np.ndarray]:
        rows = known[begin + queries.start : begin + queries.stop]
        compared = known[: begin + queries.stop] if own else known
        scores = similarity_matrix(rows, compared, settings.metric, settings.views)
        return (scores if own else scores[:, :begin]), scores[:, begin:]

    def possible(query: int) -> np.ndarray:
        return np.append(np.ones(begin, bool), request.possible(query, stamps))

    if request.seconds and not np.isfinite(stamps).all():
        raise InputError(f"{request.seconds:g} s are to be excluded, but not all frames have a stamp")
    drive = Drive(
        count - begin,
        block,
        begin if own else None,
        possible if own else None,
        speeds_between(count - begin, begin) if begin else ((1.0,),),
        visits=request.recent is None,
    )
    between, among = ((lambda a, b, at=at: pairs.agreement(check, begin + a, at + b)) for at in (0, begin))
    decider, decision = drive.decided(request.precision, check, between, among, progress)
    return Answer(results_of(decision, begin, stamps), all_of(decider, decision))


def _gray_image(recording: ImageSequence, number: int) -> np.ndarray:
    """Return an image file as gray values; black if it cannot be read, because its features are known already."""
    try:
        return read_gray(recording.paths[number])
    except InputError:
        return NOTHING
