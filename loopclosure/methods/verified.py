"""Geometric verification of another method's best matches: ``verified+METHOD`` on the command line.

The best k references of each query are compared by local features and a fundamental matrix (an essential matrix if the
camera is known). Verified pairs come before all others; within each group, the order of the inner method is kept. If
images are too small, too dark or too different to be verified, the answer of the inner method is kept. To be placed
before a better score, a pair needs 1.5 times the inliers that rule out chance, because two views of different parts of
one corridor can have just enough. With SeqSLAM, sequences are verified, not single images: a pair also counts as
verified if it lies between two verified pairs on one of its trajectories.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from loopclosure.detector.verification import GeometricCheck, Pairs
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult, earlier
from loopclosure.methods.seqslam import SeqSlam
from loopclosure.methods.settings import configure
from loopclosure.places.frames import read_gray
from loopclosure.progress import Progress, timed

ORDERS = ("score", "inliers")


@dataclass
class Verified:
    """The best ``k`` references of each query by another method, verified by geometry.

    inner           the method whose candidates are verified
    check           the check, and how many inliers it needs
    k               candidates per query
    order           the order of verified pairs: by the "score" of the inner method, or by the "inliers" of each pair;
                    with "inliers", other pairs get no score. Inliers show that two views contain the same things, but
                    not how near the cameras are
    exclude_frames  in one sequence, references within this many frames of the query are not candidates
    pairs           the cache of features and inliers
    """

    inner: Method
    check: GeometricCheck = field(default_factory=GeometricCheck)
    k: int = 20
    order: str = "score"
    exclude_frames: int = 0
    pairs: Pairs = field(default_factory=lambda: Pairs(read_gray))

    def __post_init__(self) -> None:
        if self.k < 1:
            raise InputError(f"verified examines the best k of each query, k = {self.k}; expected 1 or more")
        if self.order not in ORDERS:
            raise InputError(f'order of verified is "{self.order}"; expected {" or ".join(ORDERS)}')

    @property
    def name(self) -> str:
        """``verified+`` and the name of the inner method."""
        return f"verified+{self.inner.name}"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says."""
        found = self.inner.score(images, progress)
        seconds = dict(found.seconds)
        candidates = np.where(np.isnan(found.scores), -np.inf, found.scores)
        if images.references is None:
            candidates[~earlier(len(images.queries), self.exclude_frames)] = -np.inf
        inliers = self._inliers(candidates, images, progress, seconds)
        verified = inliers > 0
        tried = np.count_nonzero(inliers >= 0)
        notes = [
            *found.notes,
            f"{np.count_nonzero(verified)} of {tried} pairs, the best {self.k} of each query, are verified",
            f"{self.check}",
        ]
        if self.order == "inliers":
            return MethodResult(np.where(verified, inliers, np.nan), seconds, notes, found.training_stages)
        if isinstance(self.inner, SeqSlam):
            offsets, half = self.inner.settings.offsets(), self.inner.settings.length // 2
            before, after = range(half + 1), range(half, self.inner.settings.length + 1)
            verified = on_trajectories(verified, offsets, before) & on_trajectories(verified, offsets, after)
            notes.append("a pair between two verified pairs on one trajectory counts as verified")
        if not verified.any():
            notes.append("these images cannot be verified; the scores of the inner method are kept")
        known = ~np.isneginf(candidates)
        scores = np.where(known, candidates, np.nan).astype(np.float64)
        if known.any():  # verified pairs come first
            scores[verified & known] += np.ptp(scores[known]) + 1.0
        return MethodResult(scores, seconds, notes, found.training_stages)

    def _inliers(
        self, candidates: np.ndarray, images: Images, progress: Progress, seconds: dict[str, float]
    ) -> np.ndarray:
        """Return the inliers of the best k candidates of each query, 0 if too few, -1 for other pairs: (Q, R)."""
        for path in progress(images.tested, "local features", len(images.tested)):
            with timed(seconds, "local features"):
                self.pairs.features(self.check, path)
        queries, references = images.queries.paths, images.database.paths
        inliers = np.full(candidates.shape, -1, np.int64)
        for query in progress(range(len(candidates)), "verification", len(candidates)):
            with timed(seconds, "verification"):
                best = np.argsort(-candidates[query], kind="stable")[: self.k]
                for reference in best[~np.isneginf(candidates[query, best])]:
                    found = self.pairs.agreement(self.check, queries[query], references[reference])
                    inliers[query, reference] = self.check.sure(found)
        return inliers


def on_trajectories(accepted: np.ndarray, offsets: np.ndarray, part: Iterable[int] | None = None) -> np.ndarray:
    """Return the pairs (Q, R) that have an accepted one on a trajectory through them.

    offsets  (T, steps) the reference of each trajectory at each step, relative to the reference of the pair at step
             (steps - 1) // 2
    part     the steps to examine; default: all
    """
    queries, references = accepted.shape
    steps = offsets.shape[1]
    half = (steps - 1) // 2
    reach = int(np.abs(offsets).max())
    padded = np.pad(accepted, ((half, steps - 1 - half), (reach, reach)))
    supported = np.zeros_like(accepted)
    for step in range(steps) if part is None else part:
        for offset in np.unique(offsets[:, step]):
            supported |= padded[step : step + queries, reach + offset : reach + offset + references]
    return supported


def verified(settings: Mapping[str, str], context: MethodContext, inner: Method | None) -> Verified:
    """Build ``verified+METHOD``."""
    if inner is None:
        raise InputError("verified needs another method; write verified+METHOD")
    plain = Verified(inner, exclude_frames=context.exclude_frames, pairs=context.pairs)
    method, check = configure("verified", settings, plain, plain.check)
    method.check = check
    return method
