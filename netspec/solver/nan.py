"""Where a NaN or an infinity comes from, once a loss is one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch

from netspec.graph.plan import Node
from netspec.layers.contract.reading import resume, running_state
from netspec.net.net import Net


def bad_parameter(net: Net) -> str:
    """Return the first learnable blob that has a NaN or an infinity, in words; "" if none has."""
    for layer in net.layers:
        for j, blob in enumerate(layer.blobs):
            if not _is_finite(blob):
                return f'blob {j} of layer "{layer.param.name}"'
    return ""


@torch.no_grad()
def bad_top(net: Net, passes: int, part: str) -> str:
    """Run the last passes again, on the same data with the same draws; return the first bad top, in words.

    ``part`` is what :meth:`Random.begin` got for them. "" if no top is bad: what layers remember has changed.
    """
    for layer in net.layers:
        state = running_state(layer)
        if "iteration" in state:
            resume(layer, {"iteration": max(0, int(state["iteration"]) - passes)})  # pyright: ignore[reportArgumentType]
    net.random.begin(part)
    found: list[str] = []
    hooks = [
        layer.register_forward_hook(partial(_look, node, net.plan.blobs, found))
        for node, layer in zip(net.plan.nodes, net.layers, strict=True)
    ]
    try:
        for _ in range(passes):
            net.forward_loss()
    finally:
        for hook in hooks:
            hook.remove()
    return found[0] if found else ""


def _look(node: Node, names: Sequence[str], found: list[str], layer: Any, bottoms: Any, tops: Any) -> None:
    for v, top in zip(node.tops, tops if isinstance(tops, tuple) else (tops,), strict=False):
        if not _is_finite(top):
            found.append(f'top "{names[v]}" of layer "{node.name}"')


def _is_finite(values: torch.Tensor) -> bool:
    return bool(torch.isfinite(values.detach()).all())
