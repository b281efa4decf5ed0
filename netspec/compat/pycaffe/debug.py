"""``debug_info`` for solvers that run passes through the memory of blobs.

Caffe: Net::ForwardDebugInfo, Net::BackwardDebugInfo, Net::Backward (src/caffe/net.cpp)
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from netspec.compat.pycaffe.runner import BlobRunner
from netspec.solver.debug import log_all_params, log_bottom_diff, log_param_diffs, log_params, log_top


@contextmanager
def debug_info(runner: BlobRunner) -> Iterator[None]:
    """A block that logs the mean absolute values of data and diffs, in each forward and backward pass."""
    net = runner.net
    ran_backward = False

    def forward(i: int) -> None:
        for b in runner.steps[i].top_ids:
            blob = runner.blobs[b]
            log_top(net.plan.nodes[i].name, runner.names[b], blob.data_memory.tensor(blob.shape))
        log_params(net.plan.nodes[i], net.layers[i])

    def backward(i: int) -> None:
        nonlocal ran_backward
        ran_backward = True
        if not net.backward_plan.layers[i]:
            return
        for b, wanted in zip(runner.steps[i].bottom_ids, net.backward_plan.bottoms[i], strict=True):
            if wanted:
                blob = runner.blobs[b]
                log_bottom_diff(net.plan.nodes[i].name, runner.names[b], blob.diff_memory.tensor(blob.shape))
        log_param_diffs(net.plan.nodes[i], net.layers[i])

    runner.hooks["after_forward"].append(forward)
    runner.hooks["after_backward"].append(backward)
    try:
        yield
    finally:
        runner.hooks["after_forward"].remove(forward)
        runner.hooks["after_backward"].remove(backward)
    if ran_backward:
        log_all_params(net)
