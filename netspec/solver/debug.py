"""``debug_info``: the magnitude of every blob and gradient of a net during a run.

Caffe: Net::ForwardDebugInfo, Net::BackwardDebugInfo, Net::Backward (src/caffe/net.cpp)
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch

from netspec import log
from netspec.graph.plan import Node
from netspec.net.net import Net


@contextmanager
def debug_info(net: Net) -> Iterator[None]:
    """Log the mean absolute values of the blobs of forward passes within the block and, at its end, of the gradients.

    For a shared parameter, each layer shows the sum of all gradients; Caffe shows the sum so far.
    """
    diffs: dict[tuple[int, int], torch.Tensor] = {}
    hooks = [layer.register_forward_hook(partial(_forward, net, i, diffs)) for i, layer in enumerate(net.layers)]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()
    if diffs:
        _backward(net, diffs)


def log_top(layer: str, blob: str, data: torch.Tensor) -> None:
    """Log the size of a top after its layer's forward pass."""
    log.info("net.cpp:593", f"    [Forward] Layer {layer}, top blob {blob} data: {_size(data)}")


def log_params(node: Node, layer: Any) -> None:
    """Log the sizes of a layer's learnable blobs after its forward pass."""
    for j, blob in enumerate(layer.blobs):
        name = (node.params[j].name if j < len(node.params) else "") or j
        log.info("net.cpp:605", f"    [Forward] Layer {node.name}, param blob {name} data: {_size(blob)}")


def log_bottom_diff(layer: str, blob: str, diff: torch.Tensor) -> None:
    """Log the size of the gradient of a bottom after its layer's backward pass."""
    log.info("net.cpp:621", f"    [Backward] Layer {layer}, bottom blob {blob} diff: {_size(diff)}")


def log_param_diffs(node: Node, layer: Any) -> None:
    """Log the sizes of the gradients of a layer's learnable blobs after its backward pass."""
    for j, blob in enumerate(layer.blobs):
        if blob.grad is not None:
            log.info("net.cpp:632", f"    [Backward] Layer {node.name}, param blob {j} diff: {_size(blob.grad)}")


def log_all_params(net: Net) -> None:
    """Log the norms of all parameters and of all their gradients."""
    data = torch.cat([item.parameter.detach().flatten() for item in net.learnable])
    diff = torch.cat([item.parameter.grad.flatten() for item in net.learnable if item.parameter.grad is not None])
    norms = [f"({log.number(data.norm(p).item())}, {log.number(diff.norm(p).item())})" for p in (1, 2)]
    message = f"    [Backward] All net params (data, diff): L1 norm = {norms[0]}; L2 norm = {norms[1]}"
    log.logger.error(message, extra={"site": "net.cpp:721"})


def _forward(net: Net, i: int, diffs: dict[tuple[int, int], torch.Tensor], layer: Any, bottoms: Any, tops: Any) -> None:
    node = net.plan.nodes[i]
    for v, top in zip(node.tops, tops if isinstance(tops, tuple) else (tops,), strict=False):
        log_top(node.name, net.plan.blobs[v], top)
    log_params(node, layer)
    for j, bottom in enumerate(bottoms):
        if bottom.requires_grad:
            bottom.register_hook(partial(diffs.__setitem__, (i, j)))


def _backward(net: Net, diffs: dict[tuple[int, int], torch.Tensor]) -> None:
    for i, node in reversed(list(enumerate(net.plan.nodes))):
        for j, v in enumerate(node.bottoms):
            if (i, j) in diffs:
                log_bottom_diff(node.name, net.plan.blobs[v], diffs[i, j])
        log_param_diffs(node, net.layers[i])
    log_all_params(net)


def _size(blob: torch.Tensor) -> str:
    return log.number(blob.detach().abs().mean().item())
