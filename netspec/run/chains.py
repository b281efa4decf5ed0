"""Layers in a row that one kernel may compute together (netspec/layers/contract/preparing.py, RunsWith)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import torch

from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import offered

LONGEST = 3  # BatchNorm, Scale, ReLU


def chains(plan: Plan, layers: Sequence[Layer], apart: Sequence[bool]) -> list[list[int]]:
    """Return, for each layer, the numbers of those after it that may run with it; each alone reads the one before.

    ``apart`` says which layers must run by themselves. Tops that a caller wants to see are not looked at.
    """
    readers = Counter(v for node in plan.nodes for v in node.bottoms)
    found: list[list[int]] = [[] for _ in plan.nodes]
    for i, layer in enumerate(layers):
        if apart[i] or offered(layer, "run_with") is None:
            continue
        for k in range(i + 1, min(i + LONGEST, len(plan.nodes))):
            tops = plan.nodes[k - 1].tops
            if apart[k] or len(tops) != 1 or plan.nodes[k].bottoms != tops or readers[tops[0]] > 1:
                break
            found[i].append(k)
    return found


def together(layers: Sequence[Layer]) -> Callable[..., tuple[torch.Tensor, ...]]:
    """Return what runs layers of a chain: by one kernel where there is one and no hook looks at what lies between."""
    run_with, following = offered(layers[0], "run_with"), list(layers[1:])

    def run(*bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        hooked = any(layer._forward_hooks for layer in layers)
        done, tops = run_with([] if hooked else following, *bottoms)
        for layer in following[done:]:
            tops = layer.run(*tops)
        return tops

    return run
