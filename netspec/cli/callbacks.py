"""What ``netspec train`` does while a training runs: a progress bar, ``--scores`` and ``--tensorboard``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm
from typing_extensions import override

from netspec.cli.scores import Score, Scores, Snapshot, read_scores
from netspec.errors import SpecError
from netspec.solver.solver import Solver
from netspec.solver.training import Callback


class ProgressBar(Callback):
    """Shows the iterations done, the time left and the loss."""

    def __init__(self, solver: Solver, bar: tqdm) -> None:
        self._solver, self._bar = solver, bar

    @override
    def on_iteration(self) -> None:
        self._bar.update(1)
        self._bar.set_postfix_str(f"loss {self._solver.loss:.4g}", refresh=False)


class ScoresFile(Callback):
    """Writes the scores of each test and the names of the snapshots to a file. A resumed training keeps earlier ones.

    Raises SpecError if the file cannot be written, or if it is another file.
    """

    def __init__(self, solver: Solver, path: str, resumed: bool) -> None:
        self._solver, self._path = solver, path
        self._scores = read_scores(path).before(solver.iteration) if resumed and Path(path).exists() else Scores()
        self._scores.write(path)

    @override
    def on_test(self, net: int) -> None:
        self._scores.tests.append(Score(self._solver.iteration, net, self._solver.scores[net]))
        self._scores.write(self._path)

    @override
    def on_snapshot(self, model: str) -> None:
        self._scores.snapshots.append(Snapshot(self._solver.iteration, model))
        self._scores.write(self._path)


class Board(Callback):
    """Writes the loss and the rate of each iteration, and the outputs of tests, for TensorBoard."""

    def __init__(self, solver: Solver, writer: Any) -> None:
        self._solver, self._writer = solver, writer

    @override
    def on_start(self) -> None:
        self._rate = self._solver.learning_rate

    @override
    def on_iteration(self) -> None:
        solver = self._solver
        self._writer.add_scalar("train/loss", solver.loss, solver.iteration - 1)
        self._writer.add_scalar("train/learning_rate", self._rate, solver.iteration - 1)

    @override
    def on_test(self, net: int) -> None:
        solver = self._solver
        group = "test" if len(solver.test_nets) == 1 else f"test net {net}"
        for name, values in solver.scores[net].items():
            for k, value in enumerate(values):
                tag = f"{group}/{name}[{k}]" if len(values) > 1 else f"{group}/{name}"
                self._writer.add_scalar(tag, value, solver.iteration)


def writer_class() -> Any:
    """Return torch's writer for TensorBoard. Raises SpecError if the optional package tensorboard is missing."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise SpecError("--tensorboard needs an extra package: pip install 'netspec-caffe[tensorboard]'") from None
    return SummaryWriter


@contextmanager
def board(solver: Solver, folder: str | Path) -> Iterator[Board]:
    """Yield what writes a training into a folder for TensorBoard.

    A resumed training continues in its folder; results of later iterations in it are hidden. Raises SpecError if the
    package is missing.
    """
    writer = writer_class()(str(folder), purge_step=solver.iteration or None)
    try:
        yield Board(solver, writer)
    finally:
        writer.close()
