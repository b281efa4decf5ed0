"""The loops of another method's scores, without settings: ``auto+METHOD`` on the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from loopclosure.decision.constants import PRECISION
from loopclosure.decision.reasons import all_of
from loopclosure.detector.answered import results_of
from loopclosure.detector.run import verdicts_said
from loopclosure.detector.verification import GeometricCheck, Pairs
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult
from loopclosure.methods.drive import Drive, Request, speeds_between
from loopclosure.methods.settings import configure
from loopclosure.places.frames import read_gray
from loopclosure.places.sequences import PoseChoice, with_odometry
from loopclosure.progress import Progress, timed


@dataclass
class Auto:
    """The loops of another method's scores, chosen without truth; only what is accepted gets a score.

    A score is minus the logarithm, to base 10, of the share of wrong ones that is expected among loops as good.

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
        seconds, queries, two = dict(found.seconds), images.queries, images.references is not None
        if self.odometry and two:
            raise InputError("odometry is that of one sequence; these are queries and references", self.odometry)
        if self.odometry:
            queries = with_odometry(queries, PoseChoice(Path(self.odometry)))
        request = Request(self.precision, None if self.visit < 0 else self.visit, odometry=queries.odometry)
        own = np.full((len(queries), len(queries)), np.nan, np.float32) if two else found.scores
        drive = Drive(
            len(queries),
            lambda rows: (found.scores[rows.start : rows.stop], own[rows.start : rows.stop]),
            None if two else 0,
            None if two else lambda query: request.possible(query, own) & earlier(query, self.exclude_frames),
            speeds_between(*found.scores.shape) if two else ((1.0,),),
            visits=self.visit < 0,
        )
        paths, references = queries.paths, images.database.paths
        with timed(seconds, "choice and verification"):
            decider, decision = drive.decided(
                self.precision,
                self.check,
                lambda a, b: self.pairs.agreement(self.check, paths[a], references[b]),
                lambda a, b: self.pairs.agreement(self.check, paths[a], paths[b]),
                progress,
            )
        scores = np.full(found.scores.shape, np.nan)
        loops = np.flatnonzero(decision.loops)
        scores[loops, decision.match[loops]] = -np.log10(np.maximum(decision.wrong[loops], np.finfo(float).tiny))
        notes = [*found.notes, *all_of(decider, decision)]
        return MethodResult(scores, seconds, notes, found.training_stages, verdicts_said(results_of(decision)))


def earlier(query: int, exclude: int) -> np.ndarray:
    """Return which frames (query,) before one are more than ``exclude`` frames older."""
    return np.arange(query) < query - exclude


def auto(settings: Mapping[str, str], context: MethodContext, inner: Method | None) -> Auto:
    """Build ``auto+METHOD``."""
    if inner is None:
        raise InputError("auto needs a method whose scores it judges; write auto+METHOD, as in auto+features:F.npz")
    plain = Auto(inner, exclude_frames=context.exclude_frames, pairs=context.pairs)
    method, check = configure("auto", settings, plain, plain.check)
    method.check = check
    return method
