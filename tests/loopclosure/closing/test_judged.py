"""The measured poses of a method's loops, judged by ``evaluate``: as the relative pose error (RPE) of evo."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.evaluation import Evaluation, judge
from loopclosure.methods.base import Images, MethodResult
from loopclosure.places.datasets import load_sequence
from loopclosure.places.sequences import read_sequence
from loopclosure.places.truth import Exclusion
from loopclosure.progress import Progress
from loopclosure.report.files import measures_text


@dataclass
class Decided:
    """A method that decides for these pairs (query, reference)."""

    pairs: np.ndarray
    answer: str = "decided"
    name: str = "decided"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        scores = np.full((len(images.queries),) * 2, np.nan)
        scores[self.pairs[:, 0], self.pairs[:, 1]] = 1
        return MethodResult(scores, answer=self.answer)


@pytest.mark.slow
def test_the_poses_of_accepted_loops_are_judged(tmp_path: Path) -> None:
    for _ in write_walk(tmp_path / "walk", Walk(frames=40, width=160, height=120, laps=2, depth=True)):
        pass
    data = load_sequence(read_sequence(tmp_path / "walk"), exclusion=Exclusion(10))
    queries = np.flatnonzero(data.truth.queries_with_a_loop)
    pairs = np.array([(query, np.flatnonzero(data.truth.hard[query])[0]) for query in queries])
    outcome = judge("decided", Decided(pairs), data)
    said = re.search(
        r"median errors of the (\d+) measured loops, by the true poses: rotation (\S+) degrees, "
        r"direction (\S+) degrees \(of \d+\), translation (\S+) m",
        outcome.measured,
    )
    assert said is not None
    assert int(said[1]) > len(pairs) / 2
    assert float(said[2]) < 4
    assert float(said[3]) < 20
    assert float(said[4]) < 0.2
    assert f"decided: {outcome.measured}" in measures_text(Evaluation(data, [outcome]))
    assert outcome.measured in outcome.notes
    assert not judge("scores", Decided(pairs, answer=""), data).measured
