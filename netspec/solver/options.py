"""The options of a training that are not in its solver.prototxt."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from netspec import log
from netspec.errors import SpecError, check_choice
from netspec.exact import NONE
from netspec.graph.options import BuildOptions
from netspec.proto.schema import SolverParameter
from netspec.proto.source_map import Position
from netspec.solver.precision import FP32, PRECISIONS
from netspec.solver.processes import Processes

NAN = ("stop", "warn")


@dataclass(frozen=True)
class TrainingOptions:
    """How a training runs. ``build`` has the options that all of its nets share.

    ``devices`` override solver_mode and device_id: the training net is on the first, replicas of it are on the others.
    ``build.seed`` is used if there is no random_seed; without it one is drawn. Level and stages are the training net's.
    ``nan`` determines the effect of a loss that is NaN or infinite: "stop" raises SpecError, "warn" warns once. In a
    ``precision`` other than "fp32" (netspec/solver/precision.py), no sums of the training net are in Caffe's order, for
    any ``build.exact``. Each of several ``processes`` has one training net and calls the same methods; the root tests
    and writes the snapshots.
    ``action`` is called between iterations, also those of a test: "stop" ends the training, "snapshot" takes one.
    ``clock`` gives the seconds for "iter/s".
    """

    build: BuildOptions = field(default_factory=BuildOptions)
    devices: Sequence[str | torch.device] = ()
    nan: str = "stop"
    precision: str = FP32
    processes: Processes = field(default_factory=Processes)
    action: Callable[[], str | None] = lambda: None
    clock: Callable[[], float] = time.perf_counter

    def __post_init__(self) -> None:
        check_choice("precision", self.precision, PRECISIONS)
        check_choice("nan", self.nan, NAN)
        assert not (self.devices[1:] and self.processes.count > 1), "each of several processes has one device"

    @property
    def exact_sums(self) -> str:
        """Which sums of the training net are bit-identical to Caffe's."""
        return self.build.exact if self.precision == FP32 else NONE


def choose_device(param: Any, node: Position) -> torch.device:
    """Return the device set by solver_mode and device_id; the CPU, with a warning, if there is no GPU."""
    if param.solver_mode == SolverParameter.SolverMode.Value("CPU"):
        return torch.device("cpu")
    count = torch.cuda.device_count()
    if not count:
        position = node.find("solver_mode")
        log.warning("caffe.cpp:197", f"{position}: solver_mode GPU, but torch finds no GPU; running on the CPU")
        return torch.device("cpu")
    if not 0 <= param.device_id < count:
        raise SpecError(
            f"found device_id {param.device_id}, but torch finds {count} GPU(s) on this machine", node.find("device_id")
        )
    return torch.device("cuda", param.device_id)
