"""Geometric verification of another method's best matches: ``verified+METHOD`` on the command line.

The best k references of each query are compared by local features and a fundamental matrix (an essential matrix, where
the camera is known). What has too few inliers is rejected: it gets no score, so that a method that accepts nothing
finds nothing. Accepted pairs are ordered by their inliers, equal ones by the score of the inner method.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult, earlier
from loopclosure.methods.settings import configure
from loopclosure.places.frames import read_gray
from loopclosure.progress import Progress, timed

# The least of what published systems ask for (12 to 22): inliers are the score, and a threshold on it comes later.
MIN_INLIERS = 12


@dataclass
class Verified:
    """The best ``k`` references of each query by another method, verified by their geometry.

    inner           the method whose candidates are verified
    check           how, with how many inliers
    k               candidates per query
    exclude_frames  in one sequence, references within this many frames of the query are not candidates
    """

    inner: Method
    check: GeometricCheck = field(default_factory=lambda: GeometricCheck(min_inliers=MIN_INLIERS))
    k: int = 20
    exclude_frames: int = 0

    def __post_init__(self) -> None:
        if self.k < 1:
            raise InputError(f"verified examines the best k of each query, k = {self.k}; expected 1 or more")

    @property
    def name(self) -> str:
        """The inner method's name after ``verified+``."""
        return f"verified+{self.inner.name}"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says: the inliers, NaN for what is not accepted."""
        found = self.inner.score(images, progress)
        seconds = dict(found.seconds)
        local = []
        for path in progress(images.tested, "local features", len(images.tested)):
            with timed(seconds, "local features"):
                local.append(self.check.describe(read_gray(path)))
        first_reference = 0 if images.references is None else len(images.queries)
        candidates = np.where(np.isnan(found.scores), -np.inf, found.scores)
        if images.references is None:
            candidates[~earlier(len(images.queries), self.exclude_frames)] = -np.inf
        scores = np.full(found.scores.shape, np.nan)
        verified = 0
        for query in progress(range(len(candidates)), "verification", len(candidates)):
            with timed(seconds, "verification"):
                best = np.argsort(-candidates[query], kind="stable")[: self.k]
                best = best[~np.isneginf(candidates[query, best])]
                for rank, reference in enumerate(best):
                    inliers = self.check.inliers(local[query], local[first_reference + reference])
                    if self.check.accepts(inliers):
                        scores[query, reference] = inliers - rank / (self.k + 1)
                verified += len(best)
        accepted = int(np.count_nonzero(np.isfinite(scores)))
        notes = [*found.notes, f"{accepted} of the {verified} best {self.k} pairs of each query accepted; {self.check}"]
        return MethodResult(scores, seconds, notes, found.training_stages)


def verified(argument: str, context: MethodContext, inner: Method | None) -> Verified:
    """Build ``verified[:setting=value,...]+METHOD``."""
    if inner is None:
        raise InputError("verified needs a method whose best matches it verifies; write verified+METHOD")
    plain = Verified(inner, exclude_frames=context.exclude_frames)
    method, check = configure("verified", argument, plain, plain.check)
    method.check = check
    return method
