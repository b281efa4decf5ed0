"""The results of frames that were decided."""

from __future__ import annotations

import numpy as np

from loopclosure.decision.decider import Decision
from loopclosure.decision.reasons import why
from loopclosure.detector.decision import LoopResult


def results_of(
    decision: Decision, first: int = 0, stamps: np.ndarray | None = None, begin: int = 0
) -> list[LoopResult]:
    """Return the results of queries, which are numbered from ``first`` on and have these stamps (Q,), NaN for none.

    begin  the first of the queries to return the results of
    """
    results = []
    for k, match in enumerate(decision.match.tolist()[begin:], begin):
        loop, inliers = bool(decision.loops[k]), int(decision.inliers[k])
        by_line = bool(decision.by_line[k] or decision.fell[k])
        score = float(decision.line.score[k] if by_line else decision.single[k])
        stamp = np.nan if stamps is None else float(stamps[k])
        rejected = "not verified" if inliers >= 0 else "below threshold"
        results.append(
            LoopResult(
                first + k,
                [(match, score)] if match >= 0 else [],
                match if loop else None,
                "accepted" if loop else rejected if match >= 0 else "no candidate",
                score,
                inliers if inliers >= 0 else None,
                None if np.isnan(stamp) else stamp,
                why(k, decision),
                "sequence" if by_line else "image",
                wrong=float(decision.wrong[k]) if loop else None,
            )
        )
    return results
