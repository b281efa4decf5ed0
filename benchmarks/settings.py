"""Evaluates ``auto`` on drives with known loops: precision and recall of the matches that it accepts."""

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
from loopclosure.detector.verification import Agreement, Pairs
from loopclosure.evaluate import Judgment
from loopclosure.methods.auto import PRECISION, Auto
from loopclosure.methods.base import Images, MethodResult
from loopclosure.places.frames import read_bgr, read_gray
from loopclosure.progress import silent
from netspec.files.whole_file import whole_file
from netspec.inspect.features import shipped


@dataclass(frozen=True)
class Result:
    """The result of ``auto`` on one drive.

    loops      queries with a loop
    accepted   matches that auto accepts
    precision  of the accepted matches; NaN if there are none
    recall     of the accepted matches
    reasons    the reasons that auto gives
    """

    family: str
    kind: str
    loops: int
    accepted: int
    precision: float
    recall: float
    reasons: list[str]

    @property
    def precise(self) -> bool:
        """Whether the precision is high enough; it is if nothing is accepted."""
        return not self.accepted or self.precision >= PRECISION


@dataclass
class Cache:
    """What is computed once for all drives of a family, and stored in a file: descriptors and verified pairs."""

    path: Path
    rows: dict[tuple[str, Path], np.ndarray] = field(default_factory=dict)  # by the net and the image
    agreements: dict[Any, Agreement] = field(default_factory=dict)
    describe: Callable[[np.ndarray], np.ndarray] | None = None

    def __post_init__(self) -> None:
        if self.path.exists():  # pickle is safe here: save() wrote the file
            self.rows, self.agreements = pickle.loads(self.path.read_bytes())
        self.pairs = Pairs(read_gray, _found=self.agreements)
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
            unfinished.write_bytes(pickle.dumps((self.rows, self.agreements)))


@dataclass
class Scored:
    """A method that returns given scores."""

    scores: np.ndarray
    name: str = "known"

    def score(self, images: Images, progress: Any) -> MethodResult:
        """See :class:`loopclosure.methods.base.Method`."""
        return MethodResult(self.scores)


def measure(drive: Drive, cache: Cache) -> Result:
    """Run ``auto`` on one drive. Descriptors and verified pairs are taken from ``cache`` and added to it."""
    data = drive.data
    queries = cache.descriptors(data.queries.paths)
    references = None if data.references is None else cache.descriptors(data.references.paths)
    scores = similarity_matrix(queries, references)
    auto = Auto(Scored(scores), exclude_frames=data.exclude_frames, pairs=cache.pairs)
    found = auto.score(Images(data.queries, data.references), silent)
    accepted = int(np.count_nonzero(np.isfinite(found.scores)))
    judged = Judgment.of(found.scores, data.truth).best
    return Result(
        family=drive.family,
        kind=drive.kind,
        loops=int(np.count_nonzero(data.truth.queries_with_a_loop)),
        accepted=accepted,
        precision=float(judged.precision[-1]) if len(judged.precision) else float(accepted == 0),
        recall=float(judged.recall[-1]) if len(judged.recall) else 0.0,
        reasons=found.notes,
    )


def run(data: Path, work: Path, only: Sequence[str], say: Callable[[str], None]) -> list[Result]:
    """Measure all drives, or those of some families; results are added to ``work``/settings.json."""
    file = work / "settings.json"
    cache: Cache | None = None
    for drive in drives(data, work, only):
        path = work / "kept" / f"{drive.family}.pickle"
        if cache is None or cache.path != path:
            cache = Cache(path)
        result = measure(drive, cache)
        say(line(result))
        cache.save()
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
    mark = "" if result.precise else " WRONG"
    name = f"{result.family}, {result.kind}"
    return f"{name:40} {result.loops:4} {result.accepted:4} {result.precision:6.3f} {result.recall:6.3f}{mark}"


def summary(results: Sequence[Result]) -> str:
    """Return how many results are precise, and the mean recall."""
    recalls = [result.recall for result in results if result.loops]
    mean = f"{np.mean(recalls):.2f}" if recalls else "-"
    precise = sum(result.precise for result in results)
    return f"{precise} of {len(results)} drives with a precision of {PRECISION:g}; mean recall {mean}"


def halves(results: Sequence[Result]) -> str:
    """Return lines with the summary of each half of the drives, and of each family in it."""
    lines = []
    for name, first in (("first half", True), ("second half", False)):
        half = [result for result in results if (result.family in FIRST_HALF) == first]
        for family in dict.fromkeys(result.family for result in half):
            lines.append(f"  {family + ':':22}{summary([r for r in half if r.family == family])}")
        lines.append(f"{name + ':':24}{summary(half)}")
    return "\n".join(lines)
