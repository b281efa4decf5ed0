"""What the points of two images say about a match: step 4 of the decision."""

from __future__ import annotations

from math import lgamma

import numpy as np

from loopclosure.decision.constants import (
    AGAINST,
    ALIKE,
    DECADE,
    LEAST_VERIFIED,
    PRECISION,
    SURE,
    SURE_AMONG_ALIKE,
)

Share = tuple[int, int]  # so many of so many


def look_alike(part: int | np.integer, many: int | np.integer) -> bool:
    """Return whether places must be taken to look alike: of ``many`` matches with enough points, so many in part.

    They are until matches say otherwise: one more that agrees in part, of two more, counts against them.
    """
    return bool(part + 1 > ALIKE * (many + 2))


def wrong_share(evidence: np.ndarray, alike: bool) -> np.ndarray:
    """Return the share (n,) of wrong ones that is expected among single images with this evidence."""
    asked = SURE_AMONG_ALIKE if alike else SURE
    return np.minimum(1, (1 - PRECISION) * 10 ** (-(evidence - asked) / DECADE))


def in_part(verified: int, whole: int | np.integer) -> bool:
    """Return whether most of the ``verified`` matches of a stretch are not ``whole``: only a part agrees."""
    return verified >= LEAST_VERIFIED and bool(2 * whole < verified)


def too_few(verified: Share, together: int, one: Share, two: Share) -> bool:
    """Return whether too few matches of a stretch are verified for one place.

    Matches of one place are verified as often as frames of one visit that are as similar; matches of different places
    as rarely as other pairs of different places. Where frames of one visit are not verified either, as in images of
    64x32, points tell nothing.

    together  how many frames in a row tell no more than one
    one, two  how many pairs of frames of one visit, and of different places, are verified
    """
    hits, tries = verified
    if 2 * hits >= tries:
        return False
    counts = np.array([hits, tries - hits]) / together
    return bool(_log_likelihood(counts, *one) - _log_likelihood(counts, *two) < np.log(AGAINST))


def _log_likelihood(counts: np.ndarray, hits: int, tries: int) -> float:
    """Return the log of the beta-binomial likelihood of counts (yes, no) after ``hits`` of ``tries``, but a constant.

    The prior of the share is that of Jeffreys.
    """
    yes, no = hits + 0.5, tries - hits + 0.5
    return _log_beta(counts[0] + yes, counts[1] + no) - _log_beta(yes, no)


def _log_beta(a: float, b: float) -> float:
    return lgamma(a) + lgamma(b) - lgamma(a + b)
