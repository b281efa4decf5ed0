"""Loops without settings: ``auto+METHOD`` on the command line, and what ``loopclosure detect`` does.

The scores of METHOD are searched for sequences, and decoys tell which matches are loops
(:mod:`loopclosure.methods.decoys`). Points of the images confirm single matches, also where sequences tell nothing, and
reject sequences of which too few matches are verified. docs/methods.md has the formulas and the constants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d

from loopclosure.detector.decision import LoopResult
from loopclosure.detector.run import verdicts_said
from loopclosure.detector.verification import Between, GeometricCheck, Pairs
from loopclosure.errors import InputError
from loopclosure.lines.course import WINDOW
from loopclosure.methods import reasons as said
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult, earlier
from loopclosure.methods.candidates import Candidates, Compared, candidates, far_apart
from loopclosure.methods.contradiction import Visits, temporal
from loopclosure.methods.decision import Decision, decide
from loopclosure.methods.decoys import elsewhere
from loopclosure.methods.geometry import Agree, Geometry, Matches, verify
from loopclosure.methods.lines import Lines, best_lines, pool
from loopclosure.methods.settings import configure
from loopclosure.places.frames import read_gray
from loopclosure.places.pose_files import read_poses
from loopclosure.progress import Progress, silent, timed

PRECISION = 0.99
NEAR_A_STOP = 2  # frames, of those in which the camera moves


@dataclass(frozen=True)
class Answer:
    """What became of each query, and sentences that say what was chosen and why.

    The candidate of a result is the query's best reference. Its score is that of a sequence where sequences are used.
    ``limits`` are sentences about what was too much to be compared.
    """

    results: list[LoopResult]
    reasons: list[str]
    limits: list[str] = field(default_factory=list)

    @property
    def match(self) -> np.ndarray:
        """Each query's best reference (Q,), accepted or not, -1 without one."""
        return np.array([result.candidates[0][0] if result.candidates else -1 for result in self.results], int)

    @property
    def accepted(self) -> np.ndarray:
        """Which queries (Q,) close a loop with their match."""
        return np.array([bool(result) for result in self.results], bool)


@dataclass(frozen=True)
class Searched:
    """What the scores of compared frames tell, before any pair is verified: steps 1 to 3.

    said      sentences about which pairs are candidates, and which show different places
    temporal  (N, A) the score of each query with those before it; None: not known
    """

    given: Candidates
    lines: Lines | None
    matches: Matches
    said: list[str]
    temporal: np.ndarray | None = None

    @property
    def line_scores(self) -> np.ndarray:
        """The score of the best line of each query of the whole drive (N,), -inf without one."""
        none = np.full(len(self.given.queries), -np.inf)
        return (none if self.lines is None else self.lines.score)[self.given.stands]

    @property
    def image_scores(self) -> np.ndarray:
        """The score of the best single candidate of each query of the whole drive (N,), -inf without one."""
        return self.given.best[self.given.stands]


def find_matches(compared: Compared, precision: float = PRECISION) -> Searched:
    """Find the best match of each query by the scores alone, at this ``precision`` of what is accepted."""
    if not 0 < precision < 1:
        raise InputError(f"precision is {precision:g}; expected more than 0 and less than 1")
    given = candidates(compared)
    decoys, age_said = elsewhere(given)
    lines = best_lines(given, pool(given, decoys), precision)
    before = compared.temporal if compared.two else temporal(compared.scores)
    return Searched(given, lines, Matches.of(given, lines), [*filter(None, [given.said, age_said])], before)


def answer(
    searched: Searched,
    check: GeometricCheck | None = None,
    agree: Agree | None = None,
    worth: np.ndarray | None = None,
    progress: Progress = silent,
) -> Answer:
    """Decide which best matches are loops: steps 4 and 5.

    check, agree  verification of a query and a reference, by number; None: there are no images. A
                  :class:`~loopclosure.detector.verification.Between` leaves out what is fixed in the images
    worth         the queries (N,) bool whose matches are verified; None: all
    """
    given, lines, matches = searched.given, searched.lines, searched.matches
    geometry, visits = None, None
    if check is not None and agree is not None:
        rows = np.ones(len(given.queries), bool)
        if worth is not None:
            rows = np.bincount(given.stands, worth, len(rows)) > 0
        geometry = Geometry.of(given, check, agree, rows)
        matches = verify(given, lines, matches, rows, geometry, progress)
        visits = Visits.of(searched.temporal, geometry, given.two)
    decision = decide(matches, lines, given.scores, visits)
    results = _results(given, lines, matches, decision)
    reasons = [
        *searched.said,
        said.sequences(lines if matches.by_lines else None, given.far),
        said.verification(matches, geometry),
        *said.doubts(matches, decision),
        said.total(results, given, decision.alike and bool(decision.part.any())),
    ]
    return Answer(results, reasons)


def _results(given: Candidates, lines: Lines | None, matches: Matches, decision: Decision) -> list[LoopResult]:
    """Return the result of each query of the whole drive: that of the frame that stands for it."""
    rejected = np.where(matches.tried, "not verified", "below threshold")
    verdicts = np.where(decision.loops, "accepted", np.where(matches.there, rejected, "no candidate")).tolist()
    why = [said.why(row, given, matches, lines, decision) for row in range(len(verdicts))]
    results, found = [], places(given, matches, decision.loops).tolist()
    for query, (row, match) in enumerate(zip(given.stands.tolist(), found, strict=True)):
        verdict, score, inliers = verdicts[row], float(matches.score[row]), int(matches.inliers[row])
        candidates = [(match, score)] if match >= 0 else []
        accepted = match if verdict == "accepted" else None
        looked_at = matches.tried[row] and given.numbers(row, int(matches.match[row])) == (query, match)
        results.append(
            LoopResult(query, candidates, accepted, verdict, score, inliers if looked_at else None, reason=why[row])
        )
    return results


def places(given: Candidates, matches: Matches, loops: np.ndarray) -> np.ndarray:
    """Return the match (N,) of each query of the whole drive, -1 without one.

    Where cameras stand, or drive through a tunnel in which all looks the same, one frame stands for many, and which
    of them matches which is not known there and one frame further: they are spread between the matches on both sides.
    """
    frames, match = np.append(given.queries, len(given.stands)), given.references[matches.match]
    unsure = _near_a_stop(given.queries) & _near_a_stop(given.references)[matches.match]
    sure = loops & (~unsure | (matches.evidence >= 1))
    places = np.where(matches.there, match, -1)[given.stands]
    for first, last in pairwise(np.flatnonzero(sure).tolist()):
        between = slice(first, last + 1)
        line = np.interp(np.arange(first, last + 1), (first, last), matches.match[[first, last]])
        if loops[between].all() and np.abs(matches.match[between] - line).max() <= WINDOW:
            numbers = np.arange(int(frames[first]), int(frames[last]))
            places[numbers] = np.rint(np.interp(numbers, frames[[first, last]], match[[first, last]]))
    return places


def _near_a_stop(frames: np.ndarray) -> np.ndarray:
    """Return which of the frames (n,) in which a camera moved stand for several, or are near such a frame."""
    return maximum_filter1d(np.diff(frames, append=frames[-1] + 1) > 1, 2 * NEAR_A_STOP + 1, mode="constant")


@dataclass
class Auto:
    """The loops of another method's scores, chosen without truth; only what is accepted gets a score.

    precision       the share of what is accepted that should be right
    odometry        file of poses of the frames of one sequence; empty: none
    exclude_frames  in one sequence, references within this many frames of the query are not candidates
    visit           how many frames a visit to a place lasts; -1: found out, for each place
    """

    inner: Method
    check: GeometricCheck = field(default_factory=GeometricCheck)
    precision: float = PRECISION
    odometry: str = ""
    exclude_frames: int = 0
    visit: int = -1
    pairs: Pairs = field(default_factory=lambda: Pairs(read_gray))

    @property
    def name(self) -> str:
        """The inner method's name after ``auto+``."""
        return f"auto+{self.inner.name}"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says; NaN for what is not accepted."""
        found = self.inner.score(images, progress)
        seconds = dict(found.seconds)
        two = images.references is not None
        allowed, far = np.isfinite(found.scores), None
        if self.odometry:
            if two:
                raise InputError("odometry is that of one sequence; these are queries and references", self.odometry)
            queries = images.queries
            far = far_apart(read_poses(self.odometry).of_images(len(queries), queries.stamps, self.odometry))
        if not two:
            allowed &= earlier(len(images.queries), self.exclude_frames)

        agree = Between(self.check, self.pairs, images.queries.paths, images.database.paths)
        visit = None if self.visit < 0 else self.visit
        with timed(seconds, "choice and verification"):
            compared = Compared(found.scores, allowed, two, far, visit)
            decided = answer(find_matches(compared, self.precision), self.check, agree, progress=progress)
        scores = np.full(found.scores.shape, np.nan)
        loops = np.flatnonzero(decided.accepted)
        scores[loops, decided.match[loops]] = [decided.results[query].score for query in loops]
        notes = [*found.notes, *decided.reasons]
        return MethodResult(scores, seconds, notes, found.training_stages, verdicts_said(decided.results))


def auto(settings: Mapping[str, str], context: MethodContext, inner: Method | None) -> Auto:
    """Build ``auto+METHOD``."""
    if inner is None:
        raise InputError("auto needs a method whose scores it judges; write auto+METHOD, as in auto+features:F.npz")
    plain = Auto(inner, exclude_frames=context.exclude_frames, pairs=context.pairs)
    method, check = configure("auto", settings, plain, plain.check)
    method.check = check
    return method
