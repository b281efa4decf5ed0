"""The sentences of :mod:`loopclosure.methods.auto`: what was chosen, and why each match is a loop or not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopclosure.detector.decision import LoopResult
from loopclosure.lines.points import SURE, SURE_AMONG_ALIKE
from loopclosure.methods.candidates import Candidates
from loopclosure.methods.decision import Decision
from loopclosure.methods.geometry import Geometry, Matches
from loopclosure.methods.lines import Lines

DOUBTFUL = 0.1  # a smaller share of verified loops is rare where light and season are the same
TRIED = 10  # matches that a user who wants more may look at first


def sequences(lines: Lines | None, far: np.ndarray | None) -> str:
    """Return which sequences are used; ``lines`` None: none."""
    others = "where the drive is read in the other direction" if far is None else "far apart in the odometry"
    if lines is None:
        return f"sequences: none is more alike than what is seen {others}, so images are compared one by one"
    return f"{lines.course}: a match counts if it is more alike than what is seen {others}"


def verification(matches: Matches, geometry: Geometry | None) -> str:
    """Return how many matches and how many unlike pairs are verified."""
    if geometry is None:
        return "verification: not tried, there are no images"
    tried, same = np.count_nonzero(matches.tried), np.count_nonzero(matches.inliers > 0)
    few = np.count_nonzero(matches.few & (matches.inliers <= 0))
    unknown = f"; {few} frames cannot be verified" if few else ""
    unlike = f"{np.count_nonzero(geometry.unlike)} of {len(geometry.unlike)} unlike pairs"
    hidden = f" ({100 * geometry.hidden:.1f} % of the image never changes, and is left out)" if geometry.hidden else ""
    return f"verification: {same} of {tried} matches and {unlike} show the same points{hidden}{unknown}"


def doubts(matches: Matches, decision: Decision) -> list[str]:
    """Return what makes places hard to tell apart here."""
    said = list[str]()
    if decision.alike and (part := np.count_nonzero(decision.part)):
        said.append(
            f"places look alike here: in {part} of {np.count_nonzero(matches.evidence >= SURE)} matches with enough "
            f"points that agree, many others do not, so an image needs {SURE_AMONG_ALIKE:g} times the points that "
            "chance explains; --odometry tells such places apart"
        )
    if fell := np.count_nonzero(decision.fell):
        said.append(f"{fell} matches of sequences are not accepted, because their points speak against them")
    tried = decision.loops & matches.tried & ~matches.few
    same, total = np.count_nonzero(matches.inliers[tried] > 0), np.count_nonzero(tried)
    if total and same < DOUBTFUL * total:
        said.append(
            f"only {same} of {total} accepted matches show the same points: if light and season are the same, look at "
            "them; --odometry tells places that look alike apart"
        )
    return said


def total(results: Sequence[LoopResult], given: Candidates, alike: bool) -> str:
    """Return how many queries close a loop; if none does, what to look at, unless places look ``alike``."""
    loops, queries = sum(map(bool, results)), sum(bool(result.candidates) for result in results)
    if loops:
        return f"{loops} of the {queries} frames that have a candidate close a loop"
    if alike:
        return f"none of the {queries} frames that have a candidate closes a loop"
    if not queries:
        return "no frame has a candidate: the camera did not come back, or the drive is too short to tell"
    best = np.argsort(-given.best, kind="stable")[:TRIED]
    best = best[given.there[best]]  # fewer where few frames have a candidate
    least, ages = given.best[best].min(), given.queries[best] - given.references[given.single[best]]
    recent = "" if given.two else f" --exclude-recent {max(0, ages.min() - 1)}"
    tried = f"detect --threshold {np.floor(1e3 * least) / 1e3:g}{recent} accepts the most alike, to be looked at"
    return f"nothing here tells loops from chance: none is accepted ({tried})"


def why(query: int, given: Candidates, matches: Matches, lines: Lines | None, decision: Decision) -> str:
    """Return what decided about the match of one query: its sequence, and against which other place, or its points."""
    points = ""
    if matches.tried[query]:
        inliers, evidence = matches.inliers[query], matches.evidence[query]
        points = (
            f"points: {inliers} agree, {evidence:.2g} times as many as needed" if inliers else "points: too few agree"
        )
        points += ", but only a part of those that match" if decision.part[query] else ""
    if lines is None or not matches.by_lines:
        return points
    sequence = f"sequence: {lines.score[query]:.2f}"
    if np.isfinite(lines.decoy[query]):
        away = abs(int(given.references[lines.other[query]] - given.references[matches.match[query]]))
        sequence += f", the next best {lines.decoy[query]:.2f}, {away} frames away"
    if decision.by_line[query]:
        return sequence
    if decision.fell[query]:
        return f"{sequence}; but the points of its stretch speak against it"
    return points if decision.loops[query] else "; ".join(filter(None, [sequence, points]))
