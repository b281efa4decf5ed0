"""Compares ``auto`` with the best setting that could be chosen with the truth, on drives with known loops.

For each drive: the precision and recall of the matches that ``auto`` accepts (overlapping views are not a mistake), and
the largest recall at that precision of all other settings. These are all thresholds on single images and on each of the
sequence lengths that ``auto`` may choose, with and without geometric verification.
"""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.drives import FIRST_HALF, Drive, drives
from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.detector.run import load_describe
from loopclosure.detector.verification import Agreement, GeometricCheck, Pairs
from loopclosure.evaluate import Judgment
from loopclosure.methods.auto import PRECISION, Auto
from loopclosure.methods.base import Images, MethodResult, earlier
from loopclosure.methods.lines import LENGTHS
from loopclosure.methods.seqslam import SequenceSettings, standardize, trajectory_costs
from loopclosure.places.frames import read_bgr, read_gray
from loopclosure.progress import silent
from netspec.files.whole_file import whole_file
from netspec.inspect.features import shipped

ENOUGH = 0.7  # of the best setting's recall


@dataclass(frozen=True)
class Result:
    """The result of ``auto`` on one drive.

    loops      queries with a loop
    accepted   matches that auto accepts
    precision  of the accepted matches; NaN if there are none
    recall     of the accepted matches
    best       the recall of the best setting, named ``setting``
    reasons    the reasons that auto gives
    """

    family: str
    kind: str
    loops: int
    accepted: int
    precision: float
    recall: float
    best: float
    setting: str
    reasons: list[str]

    @property
    def silent(self) -> bool:
        """Whether auto accepts nothing although there are loops."""
        return self.best > 0 and not self.accepted

    @property
    def good(self) -> bool:
        """Whether precision and recall are high enough."""
        return (not self.accepted or self.precision >= PRECISION) and self.recall >= ENOUGH * self.best


@dataclass
class Kept:
    """Results computed once for all drives of a family, and cached in a file."""

    path: Path
    rows: dict[tuple[str, Path], np.ndarray] = field(default_factory=dict)  # by the net and the image
    found: dict[Any, Agreement] = field(default_factory=dict)
    best: dict[tuple[str, str], tuple[float, str]] = field(default_factory=dict)  # by the net and the drive
    describe: Callable[[np.ndarray], np.ndarray] | None = None

    def __post_init__(self) -> None:
        if self.path.exists():  # written below
            self.rows, self.found, self.best = pickle.loads(self.path.read_bytes())
        self.pairs = Pairs(read_gray, _found=self.found)
        net = shipped.folder(shipped.DEFAULT)
        weights = (net / f"{net.name}.caffemodel").read_bytes()
        self.net = hashlib.sha256((net / "deploy.prototxt").read_bytes() + weights).hexdigest()

    def descriptors(self, images: Sequence[Path]) -> np.ndarray:
        """Return the descriptors (N, D) of images by the net that comes with the package."""
        for image in images:
            if (self.net, image) not in self.rows:
                self.describe = self.describe or load_describe("default")
                self.rows[self.net, image] = np.asarray(self.describe(read_bgr(image)), np.float32).reshape(-1)
        return np.array([self.rows[self.net, image] for image in images])

    def save(self) -> None:
        """Write the file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(self.path) as unfinished:
            unfinished.write_bytes(pickle.dumps((self.rows, self.found, self.best)))


@dataclass
class Scored:
    """A method that returns given scores."""

    scores: np.ndarray
    name: str = "known"

    def score(self, images: Images, progress: Any) -> MethodResult:
        """See :class:`loopclosure.methods.base.Method`."""
        return MethodResult(self.scores)


def measure(drive: Drive, kept: Kept) -> Result:
    """Run ``auto`` on one drive, and look for the best setting."""
    data = drive.data
    queries = kept.descriptors(data.queries.paths)
    references = None if data.references is None else kept.descriptors(data.references.paths)
    scores = similarity_matrix(queries, references)
    truth = data.soft_truth or data.truth
    auto = Auto(Scored(scores), exclude_frames=data.exclude_frames, pairs=kept.pairs)
    found = auto.score(Images(data.queries, data.references), silent)
    accepted = int(np.count_nonzero(np.isfinite(found.scores)))
    judged = Judgment.of(found.scores, truth).best
    key = kept.net, drive.kind
    if key not in kept.best:
        kept.best[key] = _best(scores, drive, kept.pairs)
    best, setting = kept.best[key]
    return Result(
        family=drive.family,
        kind=drive.kind,
        loops=int(np.count_nonzero(truth.queries_with_a_loop)),
        accepted=accepted,
        precision=float(judged.precision[-1]) if len(judged.precision) else float(accepted == 0),
        recall=float(judged.recall[-1]) if len(judged.recall) else 0.0,
        best=best,
        setting=setting,
        reasons=found.notes,
    )


def _best(scores: np.ndarray, drive: Drive, pairs: Pairs) -> tuple[float, str]:
    """Return the largest recall at the wanted precision, and its setting."""
    data, two = drive.data, drive.data.references is not None
    truth = data.soft_truth or data.truth
    if not truth.positives:
        return 0.0, "nothing to find"
    allowed = np.isfinite(scores)
    if not two:
        allowed &= earlier(len(scores), data.exclude_frames)
    tried = {"single images": np.where(allowed, scores, np.nan)}
    distances = np.where(allowed, -scores, np.nan)
    scaled = standardize(distances)
    ratio = scores.shape[1] / scores.shape[0] if two else 1.0
    for length in LENGTHS:
        sequence = SequenceSettings(length, 0.8 * ratio, 1.2 * ratio, 0.1 * ratio, contrast=0)
        tried[f"sequences of {length} frames"] = np.where(allowed, -trajectory_costs(scaled, sequence), np.nan)
    recalls = {name: _recall(matrix, truth) for name, matrix in tried.items()}
    check = GeometricCheck()
    for name in ("single images", max(recalls, key=lambda name: recalls[name])):
        known = np.where(np.isnan(tried[name]), -np.inf, tried[name])
        verified = np.full(scores.shape, np.nan)
        for query, reference in enumerate(known.argmax(axis=1)):
            if np.isfinite(known[query, reference]) and check.enough(
                pairs.agreement(check, data.queries.paths[query], data.database.paths[reference])
            ):
                verified[query, reference] = known[query, reference]
        recalls[f"{name}, verified"] = _recall(verified, truth)
    name = max(recalls, key=lambda name: recalls[name])
    return recalls[name], name


def _recall(scores: np.ndarray, truth: Any) -> float:
    return Judgment.of(scores, truth).best.recall_at_precision(PRECISION)


def run(data: Path, work: Path, only: Sequence[str], say: Callable[[str], None]) -> list[Result]:
    """Measure all drives, or those of some families; results are added to ``work``/settings.json."""
    file = work / "settings.json"
    kept: Kept | None = None
    for drive in drives(data, work, only):
        path = work / "kept" / f"{drive.family}.pickle"
        if kept is None or kept.path != path:
            kept = Kept(path)
        result = measure(drive, kept)
        say(line(result))
        kept.save()
        results = {**_stored(file), drive.name: result}  # another process may have added to it
        with whole_file(file) as unfinished:
            unfinished.write_text(json.dumps([asdict(each) for each in results.values()], indent=1), encoding="utf-8")
    return list(_stored(file).values())


def _stored(file: Path) -> dict[str, Result]:
    """Return earlier results by drive."""
    found = json.loads(file.read_text(encoding="utf-8")) if file.exists() else []
    return {f"{each['family']}/{each['kind']}": Result(**each) for each in found}


def line(result: Result) -> str:
    """Return one line that summarizes a result."""
    share = f"{result.recall / result.best:.2f}" if result.best else "-"
    mark = "" if result.good else " silent" if result.silent else " MISSED"
    return (
        f"{result.family + ', ' + result.kind:40} {result.loops:4} {result.accepted:4} {result.precision:6.3f} "
        f"{result.recall:6.3f} {result.best:6.3f} {share:>5}{mark}"
    )


def summary(results: Sequence[Result]) -> str:
    """Return how many drives have a good result."""
    right = sum(not r.accepted or r.precision >= PRECISION for r in results)
    there = [r for r in results if r.best > 0]
    enough = sum(r.recall >= ENOUGH * r.best for r in there)
    return (
        f"{right} of {len(results)} drives with a precision of {PRECISION:g}; {enough} of {len(there)} with {ENOUGH:g} "
        f"of the best recall; on {sum(r.silent for r in there)} auto cannot tell"
    )


def halves(results: Sequence[Result]) -> str:
    """Say how both halves of the roads and rooms did, and their families, in lines."""
    lines = []
    for name, first in (("first half", True), ("second half", False)):
        half = [result for result in results if (result.family in FIRST_HALF) == first]
        for family in dict.fromkeys(result.family for result in half):
            lines.append(f"  {family + ':':22}{_figures([r for r in half if r.family == family])}")
        lines.append(f"{name + ':':24}{_figures(half)}")
    return "\n".join(lines)


def _figures(results: Sequence[Result]) -> str:
    right = sum(not r.accepted or r.precision >= PRECISION for r in results)
    recalls = [r.recall for r in results if r.loops]
    mean = f"{np.mean(recalls):.2f}" if recalls else "-"
    return f"{right} of {len(results)} drives with a precision of {PRECISION:g}; mean recall {mean}"
