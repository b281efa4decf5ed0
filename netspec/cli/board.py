"""Writing a training for TensorBoard, with the optional package tensorboard."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from netspec.errors import SpecError, Where
from netspec.solver.solver import Solver


def writer_class() -> Any:
    """Return torch's writer for TensorBoard. Raises SpecError if the package is missing."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise SpecError("--tensorboard needs an extra package: pip install 'netspec-caffe[tensorboard]'") from None
    return SummaryWriter


@contextmanager
def board(solver: Solver, folder: str | Path) -> Iterator[None]:
    """Within the block, write the loss and rate of each iteration, and the outputs of tests.

    A resumed training continues in its folder; results of later iterations in it are hidden. Raises
    SpecError if the package is missing or the folder cannot be written.
    """
    try:
        os.makedirs(folder, exist_ok=True)
        writer = writer_class()(str(folder), purge_step=solver.iteration or None)
    except OSError as fault:
        raise SpecError(f"cannot be written: {fault.strerror}", Where(str(folder))) from None
    start, after, tested = solver.on_start, solver.on_iteration, solver.on_test
    rate = 0.0

    def on_start() -> None:
        nonlocal rate
        start()
        rate = solver.learning_rate

    def on_iteration() -> None:
        after()
        writer.add_scalar("train/loss", solver.loss, solver.iteration - 1)
        writer.add_scalar("train/learning_rate", rate, solver.iteration - 1)

    def on_test(net: int) -> None:
        tested(net)
        group = "test" if len(solver.test_nets) == 1 else f"test net {net}"
        for name, values in solver.scores[net].items():
            for k, value in enumerate(values):
                writer.add_scalar(
                    f"{group}/{name}[{k}]" if len(values) > 1 else f"{group}/{name}", value, solver.iteration
                )

    solver.on_start, solver.on_iteration, solver.on_test = on_start, on_iteration, on_test
    try:
        yield
    finally:
        solver.on_start, solver.on_iteration, solver.on_test = start, after, tested
        writer.close()
