"""Loops without settings: ``auto+METHOD`` on the command line, and what ``loopclosure detect`` does.

The scores of METHOD are searched for sequences, and decoys tell which matches are loops
(:mod:`loopclosure.methods.decoys`). Matches are verified by geometry where that can work here: it must find many of the
matches and none of the pairs that the scores call unlike. Then what is verified is a loop even where sequences tell
nothing, and a sequence without a verified pair is rejected.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from loopclosure.detector.decision import LoopResult
from loopclosure.detector.run import verdicts_said
from loopclosure.detector.verification import Between, GeometricCheck, Pairs
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult, earlier
from loopclosure.methods.candidates import Candidates, candidates, far_apart
from loopclosure.methods.decoys import Lines, Matches, best_setting
from loopclosure.methods.geometry import Agree, kept, try_geometry, verify
from loopclosure.methods.settings import configure
from loopclosure.places.frames import read_gray
from loopclosure.places.pose_files import read_poses
from loopclosure.progress import Progress, silent, timed

PRECISION = 0.99
TRIED = 10  # matches that a user who wants more may look at first


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


def answer(
    scores: np.ndarray,
    allowed: np.ndarray,
    two: bool,
    precision: float = PRECISION,
    check: GeometricCheck | None = None,
    agree: Agree | None = None,
    progress: Progress = silent,
    far: np.ndarray | None = None,
    stamps: np.ndarray | None = None,
    visit: int | None = None,
) -> Answer:
    """Decide which best matches of scores (Q, R), higher = more alike, are loops.

    allowed    (Q, R) bool: the candidates
    two        two traverses, in the order of time each, or one sequence with itself
    precision  the share of what is accepted that should be right
    check, agree  verification of a query and a reference, by number; None: there are no images. A
               :class:`~loopclosure.detector.verification.Between` leaves out what is fixed in the images
    far        (Q, R) bool: pairs that odometry puts far apart; they are no candidates, and show how others score
    stamps     (Q,) seconds of the queries, NaN or None where not known
    visit      in one sequence, a reference is a candidate of a query if it is more than so many frames older; None: if
               in between the camera saw what is as unlike both as different places are
    """
    if not 0 < precision < 1:
        raise InputError(f"precision is {precision:g}; expected more than 0 and less than 1")
    count, given = len(scores), candidates(scores, allowed, two, far, visit)
    del scores, allowed, far  # what is left of them is in the candidates
    lines = best_setting(given, precision)
    matches = Matches.of(given, lines, precision)
    loops, said = matches.accepted, "verification: not tried, there are no images"
    if check is not None and agree is not None:
        geometry = try_geometry(given, matches, check, agree)
        said = geometry.said
        if geometry.unlike is not None:
            verify(given, lines, matches, geometry, progress)
            loops = kept(matches, geometry, lines, precision)
    rejected = np.where(
        matches.accepted if lines is not None else matches.inliers >= 0, "not verified", "below threshold"
    )
    verdicts = np.where(loops, "accepted", np.where(matches.there, rejected, "no candidate"))
    results = _results(given, matches, verdicts.tolist(), np.full(count, np.nan) if stamps is None else stamps)
    unknown = int(np.count_nonzero(matches.few & (matches.inliers <= 0)))
    reasons = [*filter(None, [given.said]), _sequences_said(lines, given.others)]
    reasons.append(said + (f"; {unknown} frames cannot be verified" if unknown else ""))
    there = sum(bool(result.candidates) for result in results)
    reasons.append(_total_said(sum(map(bool, results)), there, given))
    return Answer(results, reasons)


def _results(given: Candidates, matches: Matches, verdicts: list[str], stamps: np.ndarray) -> list[LoopResult]:
    """Return the result of each query of the whole drive: that of the frame that stands for it."""
    results = []
    for query, row in enumerate(given.stands):
        match = int(given.references[matches.match[row]]) if matches.there[row] else -1
        score, inliers, verdict = float(matches.score[row]), int(matches.inliers[row]), verdicts[row]
        results.append(
            LoopResult(
                query,
                [(match, score)] if match >= 0 else [],
                match if verdict == "accepted" else None,
                verdict,
                score,
                inliers if inliers >= 0 and given.queries[row] == query else None,
                None if np.isnan(stamps[query]) else float(stamps[query]),
            )
        )
    return results


def _sequences_said(lines: Lines | None, others: str) -> str:
    if lines is None:
        return f"sequences: none is more alike than what is seen {others}, so images are compared one by one"
    return f"{lines.setting}: a match counts if it is more alike than what is seen {others}"


def _total_said(loops: int, queries: int, given: Candidates) -> str:
    if loops:
        return f"{loops} of the {queries} frames that have a candidate close a loop"
    if not queries:
        return "no frame has a candidate: the camera did not come back, or the drive is too short to tell"
    known = given.known()
    alike = np.argsort(-known.max(axis=1), kind="stable")[:TRIED]
    alike = alike[np.isfinite(known[alike].max(axis=1))]  # fewer where few frames have a candidate
    least, ages = known[alike].max(axis=1).min(), given.queries[alike] - given.references[known[alike].argmax(axis=1)]
    recent = "" if given.two else f" --exclude-recent {max(0, ages.min() - 1)}"
    tried = f"detect --threshold {np.floor(1e3 * least) / 1e3:g}{recent} accepts the most alike, to be looked at"
    return f"nothing here tells loops from chance: none is accepted ({tried})"


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
            decided = answer(found.scores, allowed, two, self.precision, self.check, agree, progress, far, visit=visit)
        scores = np.full(found.scores.shape, np.nan)
        loops = np.flatnonzero(decided.accepted)
        scores[loops, decided.match[loops]] = [decided.results[query].score for query in loops]
        notes = [*found.notes, *decided.reasons]
        return MethodResult(scores, seconds, notes, found.training_stages, verdicts_said(decided.results))


def auto(argument: str, context: MethodContext, inner: Method | None) -> Auto:
    """Build ``auto[:setting=value,...]+METHOD``."""
    if inner is None:
        raise InputError("auto needs a method whose scores it judges; write auto+METHOD, as in auto+features:F.npz")
    plain = Auto(inner, exclude_frames=context.exclude_frames, pairs=context.pairs)
    method, check = configure("auto", argument, plain, plain.check)
    method.check = check
    return method
