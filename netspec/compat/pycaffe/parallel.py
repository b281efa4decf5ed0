"""Training in several parallel processes, as Caffe's python/train.py starts them; and a timer.

Caffe's NCCL class averages the gradients of all solvers; here torch.distributed does, on GPUs through the NCCL library.

Caffe: src/caffe/parallel.cpp, python/caffe/_caffe.cpp
"""

from __future__ import annotations

import os
import tempfile
import time
import uuid
from pathlib import Path

from torch import distributed

from netspec.compat.pycaffe import mode
from netspec.compat.pycaffe.solver import Solver
from netspec.solver.processes import Processes, join
from netspec.solver.replicas import Replicas


def has_nccl() -> bool:
    """Return whether torch has NVIDIA's NCCL. Without it, processes train in parallel on CPUs."""
    return distributed.is_available() and distributed.is_nccl_available()


class NCCL:
    """Connects the solvers of ``solver_count()`` processes with the same ``uid``.

    Every process calls ``set_solver_rank`` and then makes its own; the constructor waits for the others.
    """

    def __init__(self, solver: Solver, uid: bytes) -> None:
        count = mode.solver_count()
        if count == 1:
            processes = Processes()
        elif distributed.is_initialized():
            processes = Processes(mode.solver_rank(), count)
        else:
            processes = join(count, mode.solver_rank(), f"file://{Path(tempfile.gettempdir(), os.fsdecode(uid))}")
        self._replicas = Replicas(solver._training.net, (), processes)

    @staticmethod
    def new_uid() -> bytes:
        """Return a name for a group of processes."""
        return f"netspec-{uuid.uuid4().hex}".encode()

    def bcast(self) -> None:
        """Copy the weights of the root to every process."""
        self._replicas.begin()

    def on_start(self) -> None:
        """Do nothing: all processes have the same weights."""

    def on_gradients_ready(self) -> None:
        """Replace each gradient by the mean of all processes' gradients."""
        self._replicas.reduce()

    def __call__(self, layer: int) -> None:
        """Do nothing after a layer's backward: all gradients are averaged at once (layer_wise_reduce only hurries)."""


class Timer:
    """A timer. ``ms`` is the time between ``start`` and ``stop`` in milliseconds."""

    def __init__(self) -> None:
        self._began = 0.0
        self.ms = 0.0

    def start(self) -> None:
        """Begin."""
        self._began = time.perf_counter()

    def stop(self) -> None:
        """End."""
        self.ms = (time.perf_counter() - self._began) * 1e3
