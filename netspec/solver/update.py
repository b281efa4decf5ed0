"""The update rules of Caffe's solver types, on lists of tensors.

As in Caffe, a solver overwrites the gradients step by step until they contain the values to subtract from the weights.
The lists are in the order of the net's learnable parameters. ``torch._foreach_*`` applies an operation to each tensor
of a list; on a GPU, in one kernel. All rules are elementwise, so :func:`cut` makes pieces that fit into a CPU's cache.
All steps are applied to one piece before the next, so memory is read only once.

Caffe: src/caffe/solvers/*.cpp
"""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from netspec.errors import SpecError, did_you_mean
from netspec.exact.blas import sum_of_squares
from netspec.exact.libm import power
from netspec.proto.source_map import Position

Tensors = list[torch.Tensor] | tuple[torch.Tensor, ...]
BLOCK = 2**18  # numbers; with gradients and history, 3 MB or 4 MB


def clear(parameters: Iterable[torch.nn.Parameter]) -> None:
    """Set all gradients to 0 in place; parameters without a gradient are not changed.

    Their memory is kept, since allocating it again would cost more than computing the gradients.
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    if gradients:
        torch._foreach_zero_(gradients)


def clip(diffs: Tensors, limit: float) -> tuple[float, float] | None:
    """Scale all gradients so that their common L2 norm is at most ``limit`` (SGDSolver::ClipGradients).

    Returns the norm and the factor if it scaled them. A negative limit means no limit.
    """
    if limit < 0 or not diffs:
        return None
    norm = np.sqrt(np.float32(float(sum(sum_of_squares(diff) for diff in diffs))))
    if norm <= limit or np.isnan(norm):
        return None
    factor = np.float32(limit) / norm
    torch._foreach_mul_(diffs, float(factor))
    return float(norm), float(factor)


def normalize(diffs: Tensors, iter_size: int) -> None:
    """Divide the gradients, summed over ``iter_size`` passes, to get their mean (SGDSolver::Normalize)."""
    if iter_size != 1:
        torch._foreach_mul_(diffs, 1 / iter_size)


def regularize(diffs: Tensors, weights: Tensors, decays: Sequence[float], kind: str) -> None:
    """Add each parameter's weight decay (SGDSolver::Regularize): L2 decay * w, L1 decay * sign(w), sign(0) = 0."""
    chosen = [i for i, decay in enumerate(decays) if decay]
    if not chosen:
        return
    pull = weights if len(chosen) == len(weights) else [weights[i] for i in chosen]
    pull = torch._foreach_sign(pull) if kind == "L1" else pull
    pulled = diffs if len(chosen) == len(diffs) else [diffs[i] for i in chosen]
    _add_scaled(pulled, pull, [decays[i] for i in chosen])


Compute = Callable[[Any, Tensors, Sequence[float], Tensors, int], None]


@dataclass(frozen=True)
class Rule:
    """A solver type.

    ``compute(param, diffs, rates, history, iteration)`` turns gradients into the values to subtract from the weights
    (Caffe: ComputeUpdateValue) and updates the history. ``rates`` has the learning rate of each parameter, with its
    lr_mult. ``sets`` is the number of history values per weight: the second set follows the first. ``reads`` are the
    fields of SolverParameter that only some types read.
    """

    compute: Compute
    sets: int = 1
    momentum: bool = True
    reads: tuple[str, ...] = ()


@dataclass(frozen=True)
class Piece:
    """Weights that are updated together, with their gradients and their history, one list for each set.

    ``rates`` and ``decays`` have one value for each tensor.
    """

    weights: Tensors
    diffs: Tensors
    history: Tensors
    rates: Sequence[float]
    decays: Sequence[float]


def move(rule: Rule, param: Any, piece: Piece, iteration: int) -> None:
    """Update the weights with their gradients, summed over ``iter_size`` passes (SGDSolver::ApplyUpdate, Net::Update).

    The gradients then contain the subtracted values.
    """
    normalize(piece.diffs, param.iter_size)
    regularize(piece.diffs, piece.weights, piece.decays, param.regularization_type)
    rule.compute(param, piece.diffs, piece.rates, piece.history, iteration)
    if len(piece.weights) == 1:
        piece.weights[0].sub_(piece.diffs[0])
    else:
        torch._foreach_sub_(piece.weights, piece.diffs)


def cut(piece: Piece) -> Iterator[Piece]:
    """Yield parts of about ``BLOCK`` numbers, which fit into a CPU's cache."""
    weights, diffs, history = (
        [tensor.view(-1) for tensor in each] for each in (piece.weights, piece.diffs, piece.history)
    )
    for block in _blocks(weights):
        yield Piece(
            [weights[i][part] for i, part in block],
            [diffs[i][part] for i, part in block],
            [history[first + i][part] for first in range(0, len(history), len(weights)) for i, part in block],
            [piece.rates[i] for i, _ in block],
            [piece.decays[i] for i, _ in block],
        )


def _blocks(tensors: Tensors) -> Iterator[list[tuple[int, slice]]]:
    """Yield blocks of about ``BLOCK`` numbers: the one-dimensional tensors, and the part of each.

    On a GPU, all tensors form one block, since every kernel has a fixed cost.
    """
    block: list[tuple[int, slice]] = []
    free = BLOCK
    for i, tensor in enumerate(tensors):
        longest = BLOCK if tensor.device.type == "cpu" else max(1, tensor.numel())
        for start in range(0, tensor.numel(), longest):
            part = slice(start, min(start + longest, tensor.numel()))
            if block and tensor.device.type == "cpu" and part.stop - part.start > free:
                yield block
                block, free = [], BLOCK
            block.append((i, part))
            free -= part.stop - part.start
    if block:
        yield block


def sgd(param: Any, diffs: Tensors, rates: Sequence[float], history: Tensors, iteration: int) -> None:
    """Momentum with the rate inside the history: after the rate changes, the old velocity keeps its old rate."""
    _accelerate(diffs, rates, history, param.momentum)
    if len(diffs) == 1:
        diffs[0].copy_(history[0])
    else:
        torch._foreach_copy_(diffs, history)


def nesterov(param: Any, diffs: Tensors, rates: Sequence[float], history: Tensors, iteration: int) -> None:
    """(1 + momentum) h(t) - momentum h(t-1), where h is the history of :func:`sgd`."""
    before = torch._foreach_mul(history, -param.momentum)
    _accelerate(diffs, rates, history, param.momentum)
    torch._foreach_copy_(diffs, before)
    torch._foreach_add_(diffs, history, alpha=1 + param.momentum)


def adagrad(param: Any, diffs: Tensors, rates: Sequence[float], history: Tensors, iteration: int) -> None:
    """Rate g / (sqrt(sum of g^2) + delta): delta is outside the root."""
    torch._foreach_add_(history, _powers(diffs, 2))
    _divide_by_root(diffs, history, param.delta)
    torch._foreach_mul_(diffs, rates)


def rmsprop(param: Any, diffs: Tensors, rates: Sequence[float], history: Tensors, iteration: int) -> None:
    """:func:`adagrad` with a fading sum of g^2."""
    _fade_in(history, _powers(diffs, 2), param.rms_decay)
    _divide_by_root(diffs, history, param.delta)
    torch._foreach_mul_(diffs, rates)


def adadelta(param: Any, diffs: Tensors, rates: Sequence[float], history: Tensors, iteration: int) -> None:
    """Rate g times the root of past updates' squares (the second set) over past gradients' squares (the first)."""
    gradients, updates = history[: len(diffs)], history[len(diffs) :]
    _fade_in(gradients, _powers(diffs, 2), param.momentum)
    scale = torch._foreach_add(updates, param.delta)
    torch._foreach_div_(scale, torch._foreach_add(gradients, param.delta))
    torch._foreach_mul_(diffs, _powers(scale, 0.5))
    _fade_in(updates, _powers(diffs, 2), param.momentum)
    torch._foreach_mul_(diffs, rates)


def adam(param: Any, diffs: Tensors, rates: Sequence[float], history: Tensors, iteration: int) -> None:
    """First and second moments; delta is added to the root *before* the bias correction, unlike torch's Adam."""
    means, squares = history[: len(diffs)], history[len(diffs) :]
    _fade_in(means, diffs, param.momentum)
    _fade_in(squares, torch._foreach_mul(diffs, diffs), param.momentum2)
    torch._foreach_copy_(diffs, means)
    _divide_by_root(diffs, squares, param.delta)
    t = iteration + 1
    with np.errstate(all="ignore"):  # for momenta of 1 or more, infinity or NaN as in Caffe
        beta, beta2 = np.float64(param.momentum), np.float64(param.momentum2)
        correction = np.float32(np.sqrt(1 - beta2**t) / (1 - beta**t))
    torch._foreach_mul_(diffs, [float(np.float32(rate) * correction) for rate in rates])


RULES: dict[str, Rule] = {
    "SGD": Rule(sgd),
    "Nesterov": Rule(nesterov),
    "AdaGrad": Rule(adagrad, momentum=False, reads=("delta",)),
    "RMSProp": Rule(rmsprop, momentum=False, reads=("delta", "rms_decay")),
    "AdaDelta": Rule(adadelta, sets=2, reads=("delta",)),
    "Adam": Rule(adam, sets=2, reads=("delta", "momentum2")),
}


def rule_faults(param: Any, node: Position) -> Iterator[SpecError]:
    """Yield the errors that the constructors of Caffe's solvers detect."""
    rule = RULES.get(param.type)  # capitals count, as in Caffe
    if rule is None:
        message = f'unknown solver type "{param.type}", expected one of {", ".join(RULES)}'
        yield SpecError(message + did_you_mean(param.type, list(RULES)), node.find("type"))
        return
    if param.momentum and not rule.momentum:
        yield SpecError(f"momentum cannot be used with {param.type}; remove it", node.find("momentum"))
    if param.type == "RMSProp" and not 0 <= param.rms_decay < 1:
        yield SpecError(f"rms_decay {param.rms_decay:g}, expected at least 0 and less than 1", node.find("rms_decay"))


def _accelerate(diffs: Tensors, rates: Sequence[float], history: Tensors, momentum: float) -> None:
    """Compute history = momentum * history + rate * diff."""
    if len(history) == 1:  # for one tensor, the overhead of the list operation is larger than the operation
        history[0].mul_(momentum)
    else:
        torch._foreach_mul_(history, momentum)
    _add_scaled(history, diffs, rates)


def _add_scaled(sums: Tensors, terms: Tensors, factors: Sequence[float]) -> None:
    """Compute sum = sum + factor * term, rounded once, like BLAS's axpy."""
    if len(sums) == 1:
        sums[0].add_(terms[0], alpha=factors[0])
        return
    kinds = set(factors)
    if len(kinds) == 1:
        torch._foreach_add_(sums, terms, alpha=factors[0])
        return
    for factor in kinds:
        chosen = [i for i, own in enumerate(factors) if own == factor]
        torch._foreach_add_([sums[i] for i in chosen], [terms[i] for i in chosen], alpha=factor)


def _powers(values: Tensors, exponent: float) -> Tensors:
    return [power(value, exponent) for value in values]


def _fade_in(history: Tensors, values: Tensors, keep: float) -> None:
    """Compute history = keep * history + (1 - keep) * value."""
    torch._foreach_mul_(history, keep)
    torch._foreach_add_(history, values, alpha=1 - keep)


def _divide_by_root(diffs: Tensors, squares: Tensors, delta: float) -> None:
    """Compute diff = diff / (sqrt(squares) + delta)."""
    roots = _powers(squares, 0.5)
    torch._foreach_add_(roots, delta)
    torch._foreach_div_(diffs, roots)
