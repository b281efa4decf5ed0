"""The test scores and the snapshots of a training, as a file for programs (JSON).

    {"tests": [{"iteration": 0, "net": 0, "outputs": {"loss": [0.14]}}],
     "snapshots": [{"iteration": 100, "path": "x_iter_100.caffemodel"}]}

The log has the same information for people. Infinite values and NaN are written as Python's json module writes them:
Infinity, NaN.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from netspec.errors import SpecError, Where
from netspec.files.kinds import unreadable
from netspec.files.whole_file import write_whole


@dataclass(frozen=True)
class Score:
    """One run of test net ``net``: the mean of each element of each output blob.

    ``iteration`` is that of the training; None for weights tested without a training.
    """

    iteration: int | None
    net: int
    outputs: dict[str, list[float]]


@dataclass(frozen=True)
class Snapshot:
    """The weights after ``iteration`` updates. ``path`` is the path that the solver wrote."""

    iteration: int
    path: str


@dataclass(frozen=True)
class Scores:
    """The tests and the snapshots of a training, in order."""

    tests: list[Score] = field(default_factory=list)
    snapshots: list[Snapshot] = field(default_factory=list)

    def before(self, iteration: int) -> Scores:
        """Return the scores that remain valid if the training is resumed from the snapshot at ``iteration``."""
        return Scores(
            [test for test in self.tests if (test.iteration or 0) < iteration],
            [snapshot for snapshot in self.snapshots if snapshot.iteration <= iteration],
        )

    def write(self, path: str | Path) -> None:
        """Write the file atomically. Raises SpecError if it cannot be written."""
        write_whole(path, json.dumps(asdict(self), indent=1) + "\n")


def read_scores(path: str | Path) -> Scores:
    """Read a file that ``Scores.write`` wrote. Raises SpecError for any other file."""
    where = Where(str(path))
    try:
        entries = json.loads(Path(path).read_text("utf-8"))
        tests = [Score(test["iteration"], test["net"], test["outputs"]) for test in entries["tests"]]
        return Scores(tests, [Snapshot(entry["iteration"], entry["path"]) for entry in entries["snapshots"]])
    except OSError as fault:
        raise SpecError(unreadable(path, fault), where) from None
    except (ValueError, KeyError, TypeError) as fault:
        raise SpecError(f"this is not a file written by netspec train --scores: {fault}", where) from None
