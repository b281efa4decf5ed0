"""The learning rate of an iteration: a function of the solver's parameters, the iteration and the step.

Caffe: SGDSolver::GetLearningRate (src/caffe/solvers/sgd_solver.cpp:27)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from netspec.errors import SpecError, did_you_mean
from netspec.exact.libm import exp, power
from netspec.proto.forks import forks
from netspec.proto.source_map import Position

Rate = Callable[[float, Any, int, int], Any]


@dataclass(frozen=True)
class Policy:
    """``rate(base_lr, param, iteration, step)``, and the fields of SolverParameter that it requires, and also reads."""

    needs: tuple[str, ...]
    rate: Rate
    also: tuple[str, ...] = ()


def _inv(base: float, p: Any, iteration: int, step: int) -> float:
    return base * _powf(1 + np.float32(p.gamma) * np.float32(iteration), -p.power)


def _poly(base: float, p: Any, iteration: int, step: int) -> float:
    return base * _powf(1 - np.float32(iteration) / np.float32(p.max_iter), p.power)


def _sigmoid(base: float, p: Any, iteration: int, step: int) -> np.float32:
    """Return the rate as Caffe computes it: in float, with expf."""
    exponent = np.float32(-p.gamma) * (np.float32(iteration) - np.float32(p.stepsize))
    denominator = np.float32(1) + exp(torch.tensor([exponent])).numpy()[0]
    return np.float32(base) * (np.float32(1) / denominator)


def _power(base: float, exponent: float) -> np.float64:
    return np.power(np.float64(base), np.float64(exponent))  # gives inf or nan, where Python's ** raises an error


def _powf(base: np.float32, exponent: float) -> float:
    return power(torch.tensor(base), exponent).item()


POLICIES: dict[str, Policy] = {
    "fixed": Policy((), lambda base, p, i, step: base),
    "step": Policy(("gamma", "stepsize"), lambda base, p, i, step: base * _power(p.gamma, step)),
    "exp": Policy(("gamma",), lambda base, p, i, step: base * _power(p.gamma, i)),
    "inv": Policy(("gamma",), _inv, ("power",)),
    "multistep": Policy(("gamma",), lambda base, p, i, step: base * _power(p.gamma, step), ("stepvalue",)),
    "poly": Policy(("max_iter",), _poly, ("power",)),
    "sigmoid": Policy(("gamma", "stepsize"), _sigmoid),
}


def policy_faults(param: Any, node: Position) -> Iterator[SpecError]:
    """Yield a SpecError for an unknown policy, or for each required field that is missing.

    Caffe detects a stepsize of 0 and a negative gamma only when it uses them. With a missing gamma or max_iter, its
    rate becomes 0 or infinite.
    """
    known = [*POLICIES, *forks().rates.policies]
    if param.lr_policy not in known:
        found = f'unknown lr_policy "{param.lr_policy}"' if param.lr_policy else "no lr_policy"
        hint = did_you_mean(param.lr_policy, known)
        yield SpecError(f"{found}, expected one of {', '.join(known)}{hint}", node.find("lr_policy"))
        return
    if fault := forks().rates.fault(param):
        yield SpecError(fault, node.find("lr_policy"))
    for field in POLICIES[param.lr_policy].needs if param.lr_policy in POLICIES else ():
        value = getattr(param, field)
        if not param.HasField(field):
            yield SpecError(f'lr_policy "{param.lr_policy}" needs {field}, found none', node.find("lr_policy"))
        elif value < 0 or (value == 0 and field != "gamma"):
            expected = "at least 0" if field == "gamma" else "more than 0"
            message = f'lr_policy "{param.lr_policy}" needs {field} of {expected}, found {value:g}'
            yield SpecError(message, node.find(field))


def next_step(param: Any, iteration: int, step: int) -> int:
    """Return the step of ``iteration``; ``step`` is that of the previous iteration.

    multistep increases by at most one per iteration, even if several stepvalues were passed (sgd_solver.cpp:46).
    """
    if param.lr_policy == "step":
        return iteration // param.stepsize
    if param.lr_policy == "multistep" and step < len(param.stepvalue) and iteration >= param.stepvalue[step]:
        return step + 1
    return step


def learning_rate(param: Any, iteration: int, step: int) -> float:
    """Return the rate of an iteration in a step, rounded to float32 as in Caffe.

    Raises SpecError if the rate is not a number, as for poly beyond max_iter.
    """

    def caffes(base: float) -> Any:
        return POLICIES[param.lr_policy].rate(base, param, iteration, step)

    with np.errstate(all="ignore"):
        rate = float(np.float32(forks().rates.rate(param, iteration, caffes)))
    if not math.isfinite(rate):
        message = f'lr_policy "{param.lr_policy}" gives the learning rate {rate} at iteration {iteration}'
        raise SpecError(f"{message} (max_iter {param.max_iter})")
    return rate
