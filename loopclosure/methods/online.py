"""The online detector as a method: ``detector`` on the command line.

It gets the frames in order, and decides with exclusion, threshold, consistency and geometric verification. Only the
accepted pairs get a score.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from loopclosure.descriptors.feature_file import read_features
from loopclosure.detector.decision import DetectorSettings
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.run import run_detector, verdicts_said
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult
from loopclosure.methods.settings import configure
from loopclosure.progress import Progress, timed

# Where the settings of detector:FILE.npz:SETTINGS begin.
SETTINGS_BEGIN = re.compile(r":(?=\w+=)")


@dataclass
class OnlineMethod:
    """A :class:`LoopDetector` on descriptors from a file.

    features            a file that ``netspec extract --images`` wrote
    threshold           smallest score of a loop; NaN: chosen from the frames so far (:class:`DetectorSettings`)
    verify              verify candidates by ``check``
    """

    features: Path
    settings: DetectorSettings = field(default_factory=DetectorSettings)
    check: GeometricCheck = field(default_factory=GeometricCheck)
    threshold: float = float("nan")
    verify: bool = False

    @property
    def name(self) -> str:
        """The name of the file, and whether candidates are verified."""
        return f"detector, {self.features.stem}{', verified' if self.verify else ''}"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says: the score of each accepted pair, else NaN."""
        if images.references is not None:
            raise InputError("the detector finds loops in one sequence; separate references are not accepted")
        described = read_features(self.features)
        threshold = None if np.isnan(self.threshold) else self.threshold
        settings = replace(self.settings, threshold=threshold, views=described.views)
        detector = LoopDetector(settings=settings, check=self.check if self.verify else None)
        seconds: dict[str, float] = {}
        if np.isfinite(described.seconds_per_image):
            seconds["features"] = described.seconds_per_image * len(images.queries)
        with timed(seconds, "detection"):
            results = run_detector(detector, images.queries, described, progress)
        scores = np.full((len(results), len(results)), np.nan)
        for result in results:
            if result.accepted is not None:
                scores[result.query_id, result.accepted] = result.score
        notes = [f"{detector.settings}", f"{detector.check or 'no geometric verification'}"]
        return MethodResult(scores, seconds, notes, answer=verdicts_said(results))


def online(argument: str, context: MethodContext, inner: Method | None) -> OnlineMethod:
    """Build ``detector:FILE.npz[:threshold=T,setting=value,...]``."""
    path, *settings = SETTINGS_BEGIN.split(argument, maxsplit=1)
    if not path.endswith(".npz"):
        raise InputError(
            f'"detector:{argument}": expected detector:FILE.npz, or with settings detector:FILE.npz:verify=yes'
        )
    method, detector, check = configure(
        "detector",
        "".join(settings),
        OnlineMethod(Path(path)),
        DetectorSettings(exclude_recent=context.exclude_frames),
        GeometricCheck(),
    )
    method.settings, method.check = detector, check
    return method
