"""A pass forward and backward, layer by layer, by the clock (Caffe: tools/caffe.cpp, time)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from netspec.run.walk import Step, Values, walk


def timed(
    steps: Sequence[Step],
    values: Values,
    exact: str,
    wanted: Sequence[Sequence[bool]],
    forward: list[float],
    backward: list[float],
) -> float:
    """Run the steps on ``values``, then each backward on its own graph; return the weighted sum of the losses.

    ``wanted[i]`` says which bottoms of layer i get a gradient. The seconds that it takes are added to ``forward[i]``
    and ``backward[i]``.
    """
    made: list[tuple[Step, list[torch.Tensor], tuple[torch.Tensor, ...]]] = []

    def visit(step: Step, bottoms: list[torch.Tensor]) -> tuple[torch.Tensor, ...]:
        asked = zip(bottoms, wanted[step.node] or [False] * len(bottoms), strict=True)  # an input has none
        leaves = [x.detach().requires_grad_(want and x.is_floating_point()) for x, want in asked]
        tops, seconds = _seconds(step.run, leaves)
        forward[step.node] += seconds
        made.append((step, leaves, tops))
        return tops

    loss = walk(steps, values, exact, visit)
    gradients: dict[int, torch.Tensor] = {}
    for step, leaves, tops in reversed(made):
        weights = dict(step.losses)
        ends = []
        for j, top in enumerate(tops):
            diff = gradients.get(step.tops[j]) if j < len(step.tops) else None
            diff = torch.full_like(top, weights[j]) if j in weights else diff
            if diff is not None and top.requires_grad:
                ends.append((top, diff))
        if ends:
            _, seconds = _seconds(torch.autograd.backward, [list(each) for each in zip(*ends, strict=True)])
            backward[step.node] += seconds
        for v, leaf in zip(step.bottoms, leaves, strict=True):
            if leaf.grad is not None:
                gradients[v] = gradients[v] + leaf.grad if v in gradients else leaf.grad
    return 0.0 if loss is None else loss.item()


def _seconds(call: Callable[..., Any], arguments: Sequence[Any]) -> tuple[Any, float]:
    _wait()
    start = time.perf_counter()
    found = call(*arguments)
    _wait()
    return found, time.perf_counter() - start


def _wait() -> None:
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
