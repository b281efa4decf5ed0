"""``debug_info``: how large every blob and gradient of a net is, as it runs.

Caffe: Net::ForwardDebugInfo, Net::BackwardDebugInfo, Net::Backward (src/caffe/net.cpp)
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch

from netspec import log
from netspec.net.net import Net


@contextmanager
def debug_info(net: Net) -> Iterator[None]:
    """Log the mean absolute values of what passes forward within the block, and at its end of what came back.

    Of a parameter that layers share, each of them shows the sum of all their gradients; Caffe shows the sum so far.
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


def _forward(net: Net, i: int, diffs: dict[tuple[int, int], torch.Tensor], layer: Any, bottoms: Any, tops: Any) -> None:
    node = net.plan.nodes[i]
    for v, top in zip(node.tops, tops if isinstance(tops, tuple) else (tops,), strict=False):
        log.info("net.cpp:593", f"    [Forward] Layer {node.name}, top blob {net.plan.blobs[v]} data: {_size(top)}")
    for j, blob in enumerate(layer.blobs):
        name = (node.params[j].name if j < len(node.params) else "") or j
        log.info("net.cpp:605", f"    [Forward] Layer {node.name}, param blob {name} data: {_size(blob)}")
    for j, bottom in enumerate(bottoms):
        if bottom.requires_grad:
            bottom.register_hook(partial(diffs.__setitem__, (i, j)))


def _backward(net: Net, diffs: dict[tuple[int, int], torch.Tensor]) -> None:
    for i, node in reversed(list(enumerate(net.plan.nodes))):
        for j, v in enumerate(node.bottoms):
            if (i, j) in diffs:
                size = _size(diffs[i, j])
                log.info(
                    "net.cpp:621", f"    [Backward] Layer {node.name}, bottom blob {net.plan.blobs[v]} diff: {size}"
                )
        for j, blob in enumerate(net.layers[i].blobs):
            if blob.grad is not None:
                log.info("net.cpp:632", f"    [Backward] Layer {node.name}, param blob {j} diff: {_size(blob.grad)}")
    data = torch.cat([item.parameter.detach().flatten() for item in net.learnable])
    diff = torch.cat([item.parameter.grad.flatten() for item in net.learnable if item.parameter.grad is not None])
    norms = [f"({log.number(data.norm(p).item())}, {log.number(diff.norm(p).item())})" for p in (1, 2)]
    message = f"    [Backward] All net params (data, diff): L1 norm = {norms[0]}; L2 norm = {norms[1]}"
    log.logger.error(message, extra={"site": "net.cpp:721"})


def _size(blob: torch.Tensor) -> str:
    return log.number(blob.detach().abs().mean().item())
