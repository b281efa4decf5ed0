"""The sentences of a decision: what was chosen, and why each match is a loop or not."""

from __future__ import annotations

import numpy as np

from loopclosure.decision.constants import DOUBTFUL, SURE_AMONG_ALIKE
from loopclosure.decision.decider import Decider, Decision


def all_of(decider: Decider, decision: Decision) -> list[str]:
    """Return what was chosen, what makes places hard to tell apart here, and how many queries close a loop."""
    tried, there = decision.inliers >= 0, decision.match >= 0
    same, lines = np.count_nonzero(decision.inliers > 0), np.count_nonzero(decision.by_line)
    (many, part), loops = decider.agreed, np.count_nonzero(decision.loops)
    said = [f"sequences: {lines} matches are on one that is more alike than what is seen in the other direction"]
    if decider.check is None:
        said.append("verification: not tried, there are no images")
    else:
        unlike = f"{sum(map(bool, decider.unlike))} of {len(decider.unlike)} unlike pairs"
        said.append(f"verification: {same} of {np.count_nonzero(tried)} matches and {unlike} show the same points")
    if decider.alike and part:
        said.append(
            f"places look alike here: in {part} of {many} matches with enough points that agree, many others do not, "
            f"so an image needs {SURE_AMONG_ALIKE:g} times the points that chance explains; --odometry tells such "
            "places apart"
        )
    if fell := np.count_nonzero(decision.fell):
        said.append(f"{fell} matches of sequences are not accepted, because their points speak against them")
    tried &= decision.loops
    same, total = np.count_nonzero(decision.inliers[tried] > 0), np.count_nonzero(tried)
    if total and same < DOUBTFUL * total:
        said.append(
            f"only {same} of {total} accepted matches show the same points: if light and season are the same, look at "
            "them; --odometry tells places that look alike apart"
        )
    if loops:
        wrong = float(decision.wrong[decision.loops].max())
        said.append(
            f"{loops} of the {np.count_nonzero(there)} frames that have a candidate close a loop; of those that are as "
            f"good as the least sure one, {wrong:.2g} are expected to be wrong"
        )
    elif there.any():
        said.append(f"none of the {np.count_nonzero(there)} frames that have a candidate closes a loop")
    else:
        said.append("no frame has a candidate: the camera did not come back, or the drive is too short to tell")
    return said


def why(query: int, decision: Decision) -> str:
    """Return what decided about the match of one query: its sequence, or its points."""
    inliers, evidence, line = decision.inliers[query], decision.evidence[query], decision.line
    points = ""
    if inliers >= 0:
        points = f"points: {inliers} agree, {evidence:.2g} times as many as needed"
        points = points if inliers else "points: too few agree"
        points += ", but only a part of those that match" if decision.part[query] else ""
    sequence = f"sequence: {line.score[query]:.2f}, the best elsewhere {line.decoy[query]:.2f}"
    if decision.by_line[query]:
        return sequence
    return f"{sequence}; but the points of its stretch speak against it" if decision.fell[query] else points
