"""The loop that runs a net step by step. Each step computes new values from earlier ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import torch

from netspec.exact.arithmetic import arithmetic
from netspec.graph.plan import Backward, Plan

Values = dict[int, torch.Tensor]  # by value number of a Plan
Result = tuple[torch.Tensor | None, Values]  # the weighted sum of the losses (None: no losses), and all values


class Loss(NamedTuple):
    """A top with a loss weight, by its index. ``learns``: whether the weight is part of the gradient."""

    top: int
    weight: float
    learns: bool = True


class Step(NamedTuple):
    """One step of a run. ``run`` takes the values ``bottoms`` and returns the values ``tops``, one or a tuple.

    ``node`` is the index of the last layer that the step runs. The values ``ends`` are not needed after the step.
    """

    node: int
    run: Callable[..., Any]
    bottoms: tuple[int, ...]
    tops: tuple[int, ...]
    losses: tuple[Loss, ...] = ()
    ends: tuple[int, ...] = ()


class Runner(Protocol):
    """One way to run a net."""

    def run(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> Result | None:
        """Run the net on the values ``given`` for its inputs. The returned values include ``kept``.

        Returns None if this runner cannot run the net, in this pass or ever.
        """
        ...


class Trainer(Protocol):
    """Runs a net forward and backward."""

    def is_watched(self) -> bool:
        """Return whether a layer or blob has hooks, which only autograd calls."""
        ...

    def run(self) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run the net forward and backward. Return the weighted sum of its losses, a scalar, and the output blobs.

        The gradients of the learnable blobs are added to ``grad``. The loss is valid until the next call.
        """
        ...


Visit = Callable[[Step, list[torch.Tensor]], Any]  # runs a step on its bottoms, and returns its tops


Losses = list[tuple[Loss, ...]]  # by layer


def losses_of(plan: Plan, loss_weights: Sequence[Sequence[float]], backward: Backward) -> Losses:
    """Return the tops with a nonzero weight; ``loss_weights[i][j]`` is the loss weight of top j of layer i.

    Caffe keeps the weight of a top in its ``diff``. A layer that reads the top, a Split too, overwrites it there with
    its own gradient. If it computes none, the weight stays, but the layer of the top may have no backward pass.
    """
    written = [zip(node.bottoms, row, strict=True) for node, row in zip(plan.nodes, backward.written, strict=True)]
    overwritten = {v for pairs in written for v, is_written in pairs if is_written}
    return [
        tuple(
            Loss(j, weight, layer_learns and overwritten.isdisjoint(node.tops[j : j + 1]))
            for j, weight in enumerate(row)
            if weight
        )
        for node, row, layer_learns in zip(plan.nodes, loss_weights, backward.layers, strict=True)
    ]


def walk(steps: Iterable[Step], values: Values, exact: str, visit: Visit | None = None) -> torch.Tensor | None:
    """Run the steps in order, reading and writing ``values``. Return the weighted sum of the losses, or None.

    ``exact`` says which sums equal Caffe's in every bit (netspec/exact). ``visit`` is called instead of each step's
    own ``run``.
    """
    loss: torch.Tensor | None = None
    for step in steps:
        _, run, bottoms, tops, losses, ends = step
        given = [values[v] for v in bottoms]
        made = run(*given) if visit is None else visit(step, given)
        if not isinstance(made, tuple):
            made = (made,)
        values.update(zip(tops, made, strict=False))  # a loss may have no top
        for j, weight, learns in losses:
            term = weighted_sum(made[j] if learns else made[j].detach(), weight, exact)
            loss = term if loss is None else loss + term
        for v in ends:
            values.pop(v, None)
    return loss


def weighted_sum(top: torch.Tensor, weight: float, exact: str) -> torch.Tensor:
    """Return what a top contributes to the net's loss (Caffe: Layer::Forward)."""
    return arithmetic(exact, top).sums(top, factor=weight)
