"""The learning rate of an iteration: a function of the solver's parameters, the iteration and the step.

Caffe: SGDSolver::GetLearningRate (src/caffe/solvers/sgd_solver.cpp:27)
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from netspec.errors import SpecError, did_you_mean
from netspec.exact.libm import exp, power
from netspec.proto.schema import added_fields
from netspec.proto.source_map import Place

Rate = Callable[[Any, int, int], Any]


@dataclass(frozen=True)
class Policy:
    """``rate(param, iteration, step)``, and the fields of SolverParameter that it requires."""

    needs: tuple[str, ...]
    rate: Rate


#: The warm-up of Intel and NVIDIA: its length, initial rate and exponent (netspec/dialects/blocks/settings.py)
_RAMPS = (("warmup_iter", "warmup_start_lr", 1), ("rampup_interval", "rampup_lr", 2))
RATES_OF_FORKS = frozenset({"stagelr", "stageiter", "min_lr", *(name for ramp in _RAMPS for name in ramp[:2])})


def _fork(param: Any, name: str, otherwise: Any = 0) -> Any:
    field = added_fields.get(param.DESCRIPTOR.full_name, {}).get(name)
    return otherwise if field is None else field.get(param)


def _stage(param: Any, iteration: int, step: int) -> float:
    rates, ends = _fork(param, "stagelr"), _fork(param, "stageiter")
    return rates[min(bisect.bisect_left(ends, iteration), len(ends) - 1)]


def _poly(p: Any, iteration: int, step: int) -> float:
    least = _fork(p, "min_lr")
    return (p.base_lr - least) * _powf(1 - np.float32(iteration) / np.float32(p.max_iter), p.power) + least


def _sigmoid(p: Any, iteration: int, step: int) -> np.float32:
    """Return the rate as Caffe computes it: in float, with expf."""
    exponent = np.float32(-p.gamma) * (np.float32(iteration) - np.float32(p.stepsize))
    denominator = np.float32(1) + exp(torch.tensor([exponent])).numpy()[0]
    return np.float32(p.base_lr) * (np.float32(1) / denominator)


def _power(base: float, exponent: float) -> np.float64:
    return np.power(np.float64(base), np.float64(exponent))  # gives inf or nan, where Python's ** raises an error


def _powf(base: np.float32, exponent: float) -> float:
    return power(torch.tensor(base), exponent).item()


POLICIES: dict[str, Policy] = {
    "fixed": Policy((), lambda p, i, step: p.base_lr),
    "step": Policy(("gamma", "stepsize"), lambda p, i, step: p.base_lr * _power(p.gamma, step)),
    "exp": Policy(("gamma",), lambda p, i, step: p.base_lr * _power(p.gamma, i)),
    "inv": Policy(("gamma",), lambda p, i, step: p.base_lr * _powf(1 + np.float32(p.gamma) * np.float32(i), -p.power)),
    "multistep": Policy(("gamma",), lambda p, i, step: p.base_lr * _power(p.gamma, step)),
    "poly": Policy(("max_iter",), _poly),
    "sigmoid": Policy(("gamma", "stepsize"), _sigmoid),
    "multifixed": Policy((), _stage),
}


def policy_faults(param: Any, node: Place) -> Iterator[SpecError]:
    """Yield a SpecError for an unknown policy, or for each required field that is missing.

    Caffe detects a stepsize of 0 and a negative gamma only when it uses them. With a missing gamma or max_iter, its
    rate becomes 0 or infinite.
    """
    policy = POLICIES.get(param.lr_policy)
    if policy is None:
        known = ", ".join(POLICIES)
        found = f'unknown lr_policy "{param.lr_policy}"' if param.lr_policy else "no lr_policy"
        hint = did_you_mean(param.lr_policy, list(POLICIES))
        yield SpecError(f"{found}, expected one of {known}{hint}", node.find("lr_policy"))
        return
    stages = [len(_fork(param, name, ())) for name in ("stagelr", "stageiter")]
    if param.lr_policy == "multifixed" and (not stages[0] or stages[0] != stages[1]):
        found = f"found {stages[0]} and {stages[1]}"
        yield SpecError(f'lr_policy "multifixed" needs as many stagelr as stageiter, {found}', node.find("lr_policy"))
    for field in policy.needs:
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
    ramps = [(_fork(param, length), _fork(param, start), power) for length, start, power in _RAMPS]
    ramp = next((ramp for ramp in ramps if iteration < ramp[0]), None)
    if ramp is None and param.lr_policy == "fixed":
        rate = param.base_lr
    else:
        with np.errstate(all="ignore"):
            if ramp:
                rate = ramp[1] + (param.base_lr - ramp[1]) * (iteration / ramp[0]) ** ramp[2]
            else:
                rate = POLICIES[param.lr_policy].rate(param, iteration, step)
            rate = float(np.float32(rate))
    if least := _fork(param, "min_lr"):
        rate = max(rate, least)
    if not math.isfinite(rate):
        message = f'lr_policy "{param.lr_policy}" gives the learning rate {rate} at iteration {iteration}'
        raise SpecError(f"{message} (max_iter {param.max_iter})")
    return rate
