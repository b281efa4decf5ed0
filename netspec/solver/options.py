"""What is chosen for a training besides its solver.prototxt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from netspec.errors import SpecError
from netspec.exact import NONE, SMALL
from netspec.proto.schema import SolverParameter
from netspec.proto.source_map import Place
from netspec.solver.precision import FP32, check_precision
from netspec.solver.processes import Processes
from netspec.terminal import log


@dataclass(frozen=True)
class TrainingOptions:
    """How a training runs.

    ``device`` overrides solver_mode and device_id; replicas of the training net run on ``others``. ``seed`` is used if
    there is no random_seed; without it one is drawn. Python layers run if ``allow_python``. Weights to start from must
    have every layer of each net if ``strict``. ``nan`` says what a loss of NaN or infinity does: "stop" raises
    SpecError, "warn" warns once. In another ``precision`` than "fp32" (netspec/solver/precision.py) the training net
    computes no sums in Caffe's order, whatever ``exact`` says. Of several ``processes`` each has one training net and
    calls the same methods; the root tests and writes the snapshots. ``compiled`` nets run through torch.compile
    (netspec/run/segments.py); they compute no sums in Caffe's order either.
    """

    device: torch.device | None = None
    others: Sequence[torch.device] = ()
    seed: int | None = None
    allow_python: bool = False
    exact: str = SMALL
    strict: bool = False
    nan: str = "stop"
    precision: str = FP32
    processes: Processes = field(default_factory=Processes)
    compiled: bool = False

    def __post_init__(self) -> None:
        check_precision(self.precision)
        assert not (self.others and self.processes.count > 1), "each of several processes has one device"

    @property
    def exact_sums(self) -> str:
        """Which sums the training net computes as Caffe does, to the last bit."""
        return self.exact if self.precision == FP32 and not self.compiled else NONE


def choose_device(param: Any, node: Place) -> torch.device:
    """Return the device set by solver_mode and device_id; the CPU, with a warning, if there is no GPU."""
    if param.solver_mode == SolverParameter.SolverMode.Value("CPU"):
        return torch.device("cpu")
    count = torch.cuda.device_count()
    if not count:
        place = node.find("solver_mode")
        log.warning("caffe.cpp:197", f"{place}: solver_mode GPU, but torch finds no GPU: running on the CPU")
        return torch.device("cpu")
    if not 0 <= param.device_id < count:
        raise SpecError(
            f"found device_id {param.device_id}, but torch finds {count} GPU(s) on this machine", node.find("device_id")
        )
    return torch.device("cuda", param.device_id)
