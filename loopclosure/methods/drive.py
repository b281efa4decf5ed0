"""The loops of a whole drive, chosen without settings: what ``loopclosure detect`` does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from loopclosure.descriptors.feature_file import Features
from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.run import remember_all
from loopclosure.detector.verification import Between, GeometricCheck, Pairs
from loopclosure.errors import InputError
from loopclosure.lines.chance import AGES
from loopclosure.methods.auto import PRECISION, Answer, Searched, answer, find_matches
from loopclosure.methods.base import BLOCK
from loopclosure.methods.candidates import Compared, far_apart
from loopclosure.methods.contradiction import temporal
from loopclosure.places.frames import gray, read_gray
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.truth import Exclusion
from loopclosure.progress import Progress, silent

TOO_MANY = "are too many to compare at once"
NOTHING = np.zeros((8, 8), np.uint8)
MOST_PAIRS = 64_000_000  # pairs of frames that are compared at once, in 0.8 GB


@dataclass(frozen=True)
class Request:
    """The settings of a decision on a whole drive.

    precision  the share of the accepted loops that should be right
    visit      how many frames a visit to a place lasts, None: found from the scores
               (:func:`loopclosure.methods.auto.answer`)
    seconds    the minimum duration of a visit
    odometry   poses (frames, 7), NaN if not known; frames that are far apart by these are not a loop
    """

    precision: float = PRECISION
    visit: int | None = None
    seconds: float = 0.0
    odometry: np.ndarray | None = None


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
    odometry = request.odometry
    if recording.unreadable and odometry is not None:
        odometry = np.delete(odometry, recording.unreadable, axis=0)
    recording = recording.readable()
    check, pairs = detector.check or GeometricCheck(), Pairs(lambda number: _gray_image(recording, number))
    if detector.check is not None:
        pairs = Pairs(detector.local_features)
    elif not recording.paths:  # frames that cannot be read later
        frames = progress(recording.frames(), "local features", len(recording))
        pairs = Pairs({number: check.describe(gray(image)) for number, image, _ in frames}.__getitem__)
    request = replace(request, seconds=detector.settings.exclude_seconds, odometry=odometry)
    found = _Comparison.of(detector, (0, len(detector)), request).decided(check, pairs, progress=progress)
    detector.decided([result for result in found.results if result], None)
    return replace(found, reasons=[*found.limits, *found.reasons])


def later_threshold(detector: LoopDetector, accepted: np.ndarray) -> float | None:
    """Return a threshold for the frames after a drive that was decided as a whole.

    It is the smallest score of an ``accepted`` frame (N,) that is higher than the scores of all frames that were not
    accepted; None if there is none.
    """
    settings, rows, stamps = detector.settings, detector.descriptors, detector.stamps
    exclusion = Exclusion(settings.recent, settings.exclude_seconds)
    single = np.full(len(rows), -np.inf)
    for start in range(0, len(rows), BLOCK):
        stop = min(start + BLOCK, len(rows))
        scores = similarity_matrix(rows[start:stop], rows[:stop], settings.metric, settings.views)
        queries, references = np.arange(start, stop), np.arange(stop)
        scores[exclusion.excludes(queries, references, stamps[start:stop], stamps[:stop])] = -np.inf
        scores[references >= queries[:, None]] = -np.inf
        single[start:stop] = scores.max(axis=1)
    others = float(np.max(single[~accepted], initial=-np.inf))
    above = single[accepted & (single > others)]
    return float(above.min()) if len(above) else None


def last_session(
    detector: LoopDetector,
    results: list[LoopResult] | None = None,
    own: bool = True,
    request: Request = USUAL,
    progress: Progress = silent,
) -> Answer:
    """Decide on the last session of a detector with a geometric check, from all of its frames.

    It is compared with each earlier session as two traverses and, if ``own``, with itself as one drive. A frame is
    verified only in the session with its best line and in the one with its best image. If there are too many earlier
    sessions, it is compared with those that contain the best candidate of most frames; in the others, each frame is
    looked up by itself. ``results`` are the results of the frames when they were added; None: they were only
    remembered.
    """
    *earlier, (begin, count) = pairwise([*detector.sessions, len(detector)])
    together = detector.check is not None and bool(earlier or own)
    if results is None and (not together or begin * (count - begin) > MOST_PAIRS):
        frames = progress(range(begin, count), "looking up", count - begin)
        results = [detector.look_up(frame) for frame in frames]
    if detector.check is None or begin == count:
        return Answer(results or [], ["nothing can be verified: decided frame by frame"])
    compared, left = earlier, []
    if results is not None:
        alike = np.array([result.candidates[0][0] for result in results if result.candidates])
        earlier.sort(key=lambda span: -np.count_nonzero((alike >= span[0]) & (alike < span[1])))
        pairs = np.cumsum([0, *((end - first) * (count - begin) for first, end in earlier)])
        many = np.count_nonzero(pairs[:-1] < MOST_PAIRS)
        compared, left = earlier[:many], earlier[many:]
    pairs_of = Pairs(detector.local_features)
    found, limits, reasons = list[list[LoopResult]](), list[str](), list[str]()
    spans = [*compared, (begin, count)][: None if own else -1]
    comparisons = [_Comparison.of(detector, span, request) for span in spans]
    for comparison, worth in zip(comparisons, _worth(comparisons), strict=True):
        answered = comparison.decided(detector.check, pairs_of, worth, progress)
        found, limits = [*found, answered.results], [*limits, *answered.limits]
        reasons += _named(answered, spans[len(found) - 1], detector.sessions, len(spans))
    if results is not None and left:
        elsewhere = [any(first <= (result.accepted or 0) < end for first, end in left) for result in results]
        none = {"candidates": [], "accepted": None, "score": -np.inf, "inliers": None}
        found.append([r if r and kept else replace(r, **none) for r, kept in zip(results, elsewhere, strict=True)])
        limits.append(f"{len(earlier)} sessions {TOO_MANY}: {len(left)} are searched frame by frame")
    best = [max(each, key=_worth_of) for each in zip(*found, strict=True)]
    return Answer(best or results or [], [*limits, *reasons], limits)


def _named(answered: Answer, span: tuple[int, int], sessions: Sequence[int], count: int) -> list[str]:
    """Return the reasons of one of ``count`` comparisons; of several, those that found no loop are said in a line."""
    if count == 1:
        return answered.reasons
    number = sessions.index(span[0])
    where = "this drive with itself" if number == len(sessions) - 1 else f"session {number:06d}"
    if not any(answered.results):
        return [f"{where}: no loop"]
    return [f"{where}: {reason}" for reason in answered.reasons]


def _worth_of(result: LoopResult) -> tuple[bool, int, bool, float]:
    """Return how sure a result is; scores are compared only with scores of the same kind."""
    return bool(result), result.inliers or 0, result.score_of == "sequence", result.score


@dataclass(frozen=True)
class _Comparison:
    """The last session, compared with the frames of another session or with itself.

    queries, references  the frames that are compared: all, or every second or third one if there are more than
             ``MOST_PAIRS`` pairs; their results also apply to the frames after them
    stamps   (N,) of all frames of the last session, NaN where not known
    """

    queries: range
    references: range
    stamps: np.ndarray
    searched: Searched

    @classmethod
    def of(cls, detector: LoopDetector, span: tuple[int, int], request: Request) -> _Comparison:
        """Compare with the frames of a ``span`` (first, end)."""
        first, end = span
        begin, two = detector.sessions[-1], first != detector.sessions[-1]
        count = len(detector) - begin
        step = math.isqrt(max(0, count * (end - first) - 1) // MOST_PAIRS) + 1
        queries, references = range(begin, len(detector), step), range(first, end, step)
        stamps = detector.stamps[begin:]
        far = None if request.odometry is None else far_apart(request.odometry[::step])
        visit = None if request.visit is None else request.visit // step
        allowed = np.ones((len(queries), len(references)), bool) if two else _earlier(stamps[::step], request.seconds)
        before = _before(detector, queries) if two else None
        compared = Compared(_compared(detector, queries, references), allowed, two, far, visit, before)
        return cls(queries, references, stamps, find_matches(compared, request.precision))

    def decided(
        self, check: GeometricCheck, pairs: Pairs, worth: np.ndarray | None = None, progress: Progress = silent
    ) -> Answer:
        """Decide for each frame; ``worth`` (N,) bool: the frames whose matches are verified, None: all."""
        step = self.queries.step
        worth = None if worth is None else worth[::step]
        between = Between(check, pairs, self.queries, self.references)
        answered = answer(self.searched, check, between, worth, progress)
        results = []
        for number, stamp in enumerate(self.stamps.tolist()):
            result = answered.results[number // step]
            results.append(
                replace(
                    result,
                    query_id=self.queries.start + number,
                    candidates=[(self.references[match], score) for match, score in result.candidates],
                    accepted=None if result.accepted is None else self.references[result.accepted],
                    inliers=None if number % step else result.inliers,
                    reason=result.reason if step == 1 else "",  # it counts compared frames
                    stamp=None if np.isnan(stamp) else stamp,
                    score_of="sequence" if self.searched.matches.by_lines else "image",
                )
            )
        thinned = (
            f"{len(self.stamps)} frames {TOO_MANY}: one of {step} is compared, and decides for the frames after it"
        )
        return Answer(results, answered.reasons, [thinned] if step > 1 else [])


def _worth(comparisons: list[_Comparison]) -> np.ndarray:
    """Return for each comparison (C, N) the frames of the last session whose matches are worth verifying in it.

    Each frame is verified in two comparisons at most: the one with its best line, and the one with its best image.
    """
    worth = np.zeros((len(comparisons), len(comparisons[0].stamps) if comparisons else 0), bool)
    for name in ("line_scores", "image_scores") if comparisons else ():
        scores = [
            np.repeat(getattr(each.searched, name), each.queries.step)[: len(each.stamps)] for each in comparisons
        ]
        there = np.flatnonzero(np.isfinite(np.max(scores, axis=0)))
        worth[np.argmax(scores, axis=0)[there], there] = True
    return worth


def _compared(detector: LoopDetector, queries: range, references: range) -> np.ndarray:
    """Return the scores (Q, R) of frames with other frames, or with themselves."""
    rows, known = (detector.descriptors_of(of.start, of.stop)[:: of.step] for of in (queries, references))
    same, settings = queries == references, detector.settings
    return similarity_matrix(rows, None if same else known, settings.metric, settings.views)


def _before(detector: LoopDetector, frames: range) -> np.ndarray:
    """Return the scores (N, A) of frames with those before them, as :func:`temporal` does."""
    rows, settings = detector.descriptors_of(frames.start, frames.stop)[:: frames.step], detector.settings
    found = np.full((len(rows), AGES), np.nan, np.float32)
    for first in range(0, len(rows), BLOCK):
        around = max(0, first - AGES)
        part = temporal(similarity_matrix(rows[around : first + BLOCK], None, settings.metric, settings.views))
        found[first : first + BLOCK, : part.shape[1]] = part[first - around :]
    return found


def _earlier(stamps: np.ndarray, seconds: float) -> np.ndarray:
    """Return which pairs of frames are candidates: for each frame, the earlier ones that are old enough."""
    numbers = np.arange(len(stamps))
    allowed = np.tri(len(stamps), k=-1, dtype=bool)
    for rows in np.array_split(numbers, len(numbers) // BLOCK + 1) if seconds else ():
        allowed[rows] &= ~Exclusion(seconds=seconds).excludes(rows, numbers, stamps[rows], stamps)
    return allowed


def _gray_image(recording: ImageSequence, number: int) -> np.ndarray:
    """Return an image file as gray values; black if it cannot be read, because its features are known already."""
    try:
        return read_gray(recording.paths[number])
    except InputError:
        return NOTHING
