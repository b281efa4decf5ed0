"""Loops without settings: ``auto+METHOD`` on the command line, and what ``loopclosure detect`` does.

The scores of METHOD are searched for sequences, and decoys tell which matches are loops
(:mod:`loopclosure.methods.decoys`). Matches are verified by geometry where that can work here: it must find many of the
matches and none of the pairs that the scores call unlike. Then what is verified is a loop even where sequences tell
nothing, and what sequences find without any verified pair on it is none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from loopclosure.detector.verification import DOUBTLESS, LEAST_MATCHES, SURE, Agreement, GeometricCheck, Pairs
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult, earlier
from loopclosure.methods.decoys import UNEVEN, Found, best_setting, threshold
from loopclosure.methods.odometry import far_apart
from loopclosure.methods.seqslam import SequenceSettings
from loopclosure.methods.settings import configure
from loopclosure.places.frames import read_gray
from loopclosure.places.pose_files import read_poses
from loopclosure.progress import Progress, silent, timed

PRECISION = 0.99
SAMPLE = 40  # matches, and unlike pairs, that tell whether verification works
# The share of what sequences accept, or without sequences the number of matches, that verification must find.
LEAST_SHARE, LEAST_FOUND = 0.5, 3
# Where at most this share of unlike pairs are verified, a verified match beside a loop is one as well.
RARELY = 0.05
WINDOW = 5  # references beside a line, and at least so many queries along it, that a verified pair vouches for
BESIDE = SequenceSettings(2 * WINDOW, *UNEVEN)  # the line through a single image that is a loop by itself

Agree = Callable[[int, int], Agreement]


@dataclass(frozen=True)
class Answer:
    """What is a loop, and why.

    match     (Q,) each query's best reference, -1 without one
    score     (Q,) its score, that of a sequence where sequences are used; -inf without one
    verdicts  Q words: "accepted", "no candidate", "below threshold", "not verified" (rejected)
    inliers   (Q,) of the match, -1 where it was not verified
    unverifiable  how many matches had too few points to be verified or rejected
    reasons   three sentences: what was chosen, and why
    """

    match: np.ndarray
    score: np.ndarray
    verdicts: list[str]
    inliers: np.ndarray
    unverifiable: int
    reasons: list[str]

    @property
    def accepted(self) -> np.ndarray:
        """Which queries (Q,) close a loop with their match."""
        return np.array([verdict == "accepted" for verdict in self.verdicts], bool)

    def counts(self) -> str:
        """Say in one sentence what became of all queries."""
        words = [f"{self.verdicts.count(word)} {word}" for word in dict.fromkeys(self.verdicts)]
        best = f"; best score {self.score.max():.4g}" if np.any(np.isfinite(self.score)) else ""
        return f"queries: {', '.join(words)}; {self.unverifiable} could not be verified{best}"


def answer(
    scores: np.ndarray,
    allowed: np.ndarray,
    two: bool,
    precision: float = PRECISION,
    check: GeometricCheck | None = None,
    agree: Agree | None = None,
    progress: Progress = silent,
    far: np.ndarray | None = None,
) -> Answer:
    """Decide which best matches of scores (Q, R), higher = more alike, are loops.

    allowed    (Q, R) bool: the candidates
    two        two traverses, in the order of time each, or one sequence with itself
    precision  the share of what is accepted that should be right
    check, agree  verification of a query and a reference, by number; None: there are no images
    far        (Q, R) bool: pairs that odometry puts far apart; they are no candidates, and show how others score
    """
    if not 0 < precision < 1:
        raise InputError(f"precision is {precision:g}; expected more than 0 and less than 1")
    allowed = allowed & np.isfinite(scores)
    different = None
    if far is not None:
        different, allowed = allowed & far, allowed & ~far
        if np.count_nonzero(different.any(axis=1)) < LEAST_SHARE * np.count_nonzero(allowed.any(axis=1)):
            different = None
    if not two:
        allowed &= earlier(len(scores), _visit(scores, allowed))
    known = np.where(allowed, scores, -np.inf)
    single = known.argmax(axis=1)
    score = known.max(axis=1)
    there = np.isfinite(score)
    match = np.where(there, single, -1)
    accepted = np.zeros(len(match), bool)
    found = best_setting(scores, allowed, two, precision, different)
    reasons = [_sequences_said(found, precision, "backwards" if different is None else "far apart in odometry")]
    if found is not None:
        match, score, accepted = found.match.copy(), found.targets, found.accepted(precision)
        there = match >= 0
    verdicts = np.where(accepted, "accepted", np.where(there, "below threshold", "no candidate")).astype(object)
    inliers = np.full(len(match), -1)
    unverifiable = 0
    if check is None or agree is None:
        reasons += ["verification: not tried, there are no images", _total_said(accepted, there)]
        return Answer(match, score, verdicts.tolist(), inliers, 0, reasons)
    unlike, keeps, said = _verification_works(known, match, score, accepted, two, check, agree)
    reasons.append(said)
    if unlike is not None:
        few = np.zeros(len(match), bool)
        evidence = np.zeros(len(match))
        for query in progress(np.flatnonzero(there), "verification", int(np.count_nonzero(there))):
            # Lamps of a tunnel repeat: one image that is verified does not overrule a sequence that is accepted.
            other = match if accepted[query] else single
            for reference in dict.fromkeys((int(match[query]), int(other[query]))):
                agreement = agree(int(query), reference)
                inliers[query] = check.enough(agreement)
                evidence[query] = check.evidence(agreement)
                few[query] = agreement.matches < LEAST_MATCHES
                if inliers[query]:
                    match[query] = reference
                    break
        unverifiable = int(np.count_nonzero(few & there & (inliers <= 0)))
        verified = inliers > 0
        # What verification alone finds must be better than what it finds in pairs that are no loop.
        least = max(SURE, threshold(evidence, unlike, precision))
        if np.count_nonzero(unlike >= DOUBTLESS) <= LEAST_SHARE * len(unlike):
            least = min(least, DOUBTLESS)
        # From afar a place is seen before the camera is there: other queries fit it better.
        near = np.ones(len(match), bool) if found is None else found.near
        sure = near & (evidence >= least)
        if np.count_nonzero(unlike >= 1) > LEAST_SHARE * len(unlike):
            verified = sure | (accepted & keeps)
        kept = sure | (accepted & _between(match, verified, found))
        rare = np.count_nonzero(unlike >= 1) <= RARELY * len(unlike)
        while rare and np.any(more := verified & near & np.any(_beside(match, kept, found), axis=0) & ~kept):
            kept |= more
        verdicts[accepted & ~kept] = "not verified"
        verdicts[there & ~accepted & ~kept] = "not verified" if found is None else "below threshold"
        verdicts[kept] = "accepted"
        accepted = verdicts == "accepted"
        if found is not None:
            score = np.where(there, found.scores[np.arange(len(match)), match], -np.inf)
            score = np.where(np.isnan(score), -np.inf, score)
    reasons.append(_total_said(accepted, there))
    return Answer(match, score, verdicts.tolist(), inliers, unverifiable, reasons)


def _visit(scores: np.ndarray, allowed: np.ndarray) -> int:
    """Return how many frames a visit to a place takes in one drive: so many are as unlike as different places are.

    A camera that stands, or a straight road, is like itself for long; that is no loop.
    """
    lags = [(k, np.median(known)) for k in range(1, len(scores)) if len(known := _finite(np.diagonal(scores, -k)))]
    visit, before = 0, -1
    while visit > before and np.any(apart := allowed & earlier(len(scores), visit)):
        different = np.median(scores[apart])
        visit, before = next((k - 1 for k, alike in lags if alike <= different), visit), visit
    return visit


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _sequences_said(found: Found | None, precision: float, others: str) -> str:
    if found is None:
        return f"sequences: none is better than others {others}, so that images are compared one by one"
    return (
        f"{found.setting}: a score of {found.threshold(precision):.4g} or more, since {others} the best of a query is "
        f"{np.median(found.decoys):.4g} in the middle and {found.decoys.max():.4g} at most"
    )


def _total_said(accepted: np.ndarray, there: np.ndarray) -> str:
    count = np.count_nonzero(accepted)
    if count:
        return f"{count} of {np.count_nonzero(there)} queries with a candidate close a loop"
    return "nothing here tells loops from chance: none is accepted (a threshold of your own accepts more)"


def _verification_works(
    known: np.ndarray,
    match: np.ndarray,
    score: np.ndarray,
    accepted: np.ndarray,
    two: bool,
    check: GeometricCheck,
    agree: Agree,
) -> tuple[np.ndarray | None, bool, str]:
    """Try matches and unlike pairs; return the evidence of these if verification tells them apart, and a sentence.

    The second value is whether matches of sequences are loops where unlike pairs are verified too.
    """
    likely = np.flatnonzero(accepted) if accepted.any() else np.argsort(-score, kind="stable")[:SAMPLE]
    likely = likely[match[likely] >= 0]
    if not len(likely):
        return None, True, "verification: not tried, no query has a candidate"
    likely = likely[np.unique(np.linspace(0, len(likely) - 1, SAMPLE).round().astype(int))]
    same = sum(check.enough(agree(int(query), int(match[query]))) > 0 for query in likely)
    wide = np.flatnonzero(np.count_nonzero(np.isfinite(known), axis=1) >= 8)
    wide = wide[np.unique(np.linspace(0, len(wide) - 1, SAMPLE).round().astype(int))] if len(wide) else wide
    against = np.zeros(len(wide))
    for number, query in enumerate(wide):
        order = np.argsort(known[query], kind="stable")
        candidates = order[np.isfinite(known[query, order])]
        # One of the least alike quarter, another quarter of them each time.
        reference = candidates[int(query) % max(1, len(candidates) // 4)]
        against[number] = check.evidence(agree(int(query), int(reference)))
    unlike = np.count_nonzero(against >= 1)
    tried = f"verification: {same} of {len(likely)} matches, {unlike} of {len(wide)} unlike pairs"
    if same < (LEAST_SHARE * len(likely) if accepted.any() else LEAST_FOUND):
        following = [check.evidence(agree(int(query), int(query) - 1)) >= SURE for query in likely if query and not two]
        if accepted.any() and following and np.mean(following) >= LEAST_SHARE:
            return (
                np.full(SAMPLE, SURE),
                False,
                f"{tried}: consecutive frames are verified, so that these are no loops",
            )
        return None, True, f"{tried}: these images cannot be verified, so that nothing is rejected for it"
    # Unlike pairs of a small place, a desk, do show the same things, and so does a dashboard in all images.
    if unlike > LEAST_SHARE * len(wide):
        return (
            against,
            True,
            f"{tried}: something is the same in all images, so that only what has far more in common is verified",
        )
    return against, True, f"{tried}: what is verified is a loop, and what has no verified pair near it is none"


def _between(match: np.ndarray, verified: np.ndarray, found: Found | None) -> np.ndarray:
    """Return the queries (Q,) that are verified or, of sequences, lie between two that are, on the line through them.

    Past the last verified match a loop has ended, though the line through it goes on.
    """
    near = _beside(match, verified, found)
    return verified | (near[0] & near[1])


def _beside(match: np.ndarray, which: np.ndarray, found: Found | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the queries that have one of ``which`` (Q,) before them, and after, on the line through their match.

    The line has the length and the velocities of the sequences, and is ``WINDOW`` references wide to each side.
    """
    before, after = np.zeros_like(which), np.zeros_like(which)
    if found is None:
        return before, after
    sequence, numbers = found.setting.sequence or BESIDE, np.arange(len(match))
    for step in range(1, max(WINDOW, sequence.length // 2) + 1):
        for sign, side in ((-1, before), (1, after)):
            other = numbers + sign * step
            inside = np.flatnonzero((other >= 0) & (other < len(match)))
            moved = (match[other[inside]] - match[inside]) * sign
            low, high = sequence.slowest * step - WINDOW, sequence.fastest * step + WINDOW
            side[inside[(moved >= low) & (moved <= high) & which[other[inside]]]] = True
    return before, after


@dataclass
class Auto:
    """The loops of another method's scores, chosen without truth; only what is accepted gets a score.

    precision       the share of what is accepted that should be right
    odometry        file of poses of the frames of one sequence; empty: none
    exclude_frames  in one sequence, references within this many frames of the query are not candidates
    stamps          (Q,) seconds, None if not known
    """

    inner: Method
    check: GeometricCheck = field(default_factory=GeometricCheck)
    precision: float = PRECISION
    odometry: str = ""
    exclude_frames: int = 0
    stamps: np.ndarray | None = None
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
        references = images.queries if images.references is None else images.references
        allowed, far = np.isfinite(found.scores), None
        if self.odometry:
            if two:
                raise InputError("odometry is that of one sequence; these are queries and references", self.odometry)
            far = far_apart(read_poses(self.odometry).of_images(len(images.queries), self.stamps, self.odometry))
        if not two:
            allowed &= earlier(len(images.queries), self.exclude_frames)

        def agree(query: int, reference: int) -> Agreement:
            return self.pairs.agreement(self.check, images.queries[query], references[reference])

        with timed(seconds, "choice and verification"):
            decided = answer(found.scores, allowed, two, self.precision, self.check, agree, progress, far)
        scores = np.full(found.scores.shape, np.nan)
        loops = np.flatnonzero(decided.accepted)
        scores[loops, decided.match[loops]] = decided.score[loops]
        notes = [*found.notes, *decided.reasons]
        return MethodResult(scores, seconds, notes, found.training_stages, decided.counts())


def auto(argument: str, context: MethodContext, inner: Method | None) -> Auto:
    """Build ``auto[:setting=value,...]+METHOD``."""
    if inner is None:
        raise InputError("auto needs a method whose scores it judges; write auto+METHOD, as in auto+features:F.npz")
    plain = Auto(inner, exclude_frames=context.exclude_frames, stamps=context.stamps, pairs=context.pairs)
    method, check = configure("auto", argument, plain, plain.check)
    method.check = check
    return method
