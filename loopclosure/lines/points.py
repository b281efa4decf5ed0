"""Whether the points of the matches of a stretch speak against it."""

from __future__ import annotations

import numpy as np
from scipy.special import betaln

AGAINST = 0.01  # a stretch falls if the ratio of the likelihoods is less
ALIKE = 0.25  # of the matches with enough points: if more of them agree only in part, places look alike
# Evidence of a single image that is accepted by its points: once is not enough, the windows of a facade repeat and
# agree more often than by chance. The more is needed where places look alike.
SURE, SURE_AMONG_ALIKE = 1.5, 2.5
LEAST_VERIFIED = 3  # fewer verified matches of a stretch do not tell whether they agree only in part

Share = tuple[int, int]  # so many of so many


def look_alike(part: int | np.integer, many: int | np.integer) -> bool:
    """Return whether places must be taken to look alike: of ``many`` matches with enough points, so many in part.

    They are until matches say otherwise: one more that agrees in part, of two more, counts against them.
    """
    return bool(part + 1 > ALIKE * (many + 2))


def asked(alike: bool) -> float:
    """Return the evidence that a single image needs."""
    return SURE_AMONG_ALIKE if alike else SURE


def in_part(verified: int, whole: int | np.integer) -> bool:
    """Return whether most of the ``verified`` matches of a stretch are not ``whole``: only a part agrees."""
    return verified >= LEAST_VERIFIED and bool(2 * whole < verified)


def too_few(verified: Share, together: int, one: Share, two: Share) -> bool:
    """Return whether too few matches of a stretch are verified for one place.

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
    return float(betaln(counts[0] + yes, counts[1] + no) - betaln(yes, no))
