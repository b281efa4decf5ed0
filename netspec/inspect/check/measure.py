"""Runs a net to measure it: ``caffe test`` and ``caffe time`` (Caffe: tools/caffe.cpp)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from netspec.log import info, number
from netspec.net.net import Net
from netspec.run.walk import Step, walk
from netspec.solver.testing import Outputs, Tally, score_lines, scorers


def test_net(net: Net, iterations: int) -> Outputs:
    """Run ``iterations`` batches; log each batch's outputs and their means, and return the means by output blob."""
    info("caffe.cpp:281", f"Running for {iterations} iterations.")
    tally = Tally(scorers(net))
    with torch.no_grad():
        for batch in range(iterations):
            for name, values in tally.add(*net.forward_loss()).items():
                for value in values:
                    info("caffe.cpp:304", f"Batch {batch}, {name} = {number(value)}")
    info("caffe.cpp:309", f"Loss: {number(tally.loss)}")
    scores = tally.scores
    for line in score_lines(scores, net.output_loss_weights):
        info("caffe.cpp:321", line)
    return scores


def time_net(net: Net, iterations: int) -> None:
    """Run ``iterations`` forward and backward passes layer by layer and log the milliseconds of each layer."""
    layers = len(net.layers)
    info("caffe.cpp:351", "Performing Forward")
    info("caffe.cpp:356", f"Initial loss: {number(_pass(net, [0.0] * layers, [0.0] * layers))}")
    info("caffe.cpp:357", "Performing Backward")
    forward, backward = [0.0] * layers, [0.0] * layers
    total = _milliseconds(iterations, "forward-backward", lambda: _pass(net, forward, backward))
    info("caffe.cpp:397", "Average time per layer: ")
    for node, ahead, back in zip(net.plan.nodes, forward, backward, strict=True):
        info("caffe.cpp:400", f"{node.name:>10}\tforward: {number(ahead * 1e3 / iterations)} ms.")
        info("caffe.cpp:403", f"{node.name:>10}\tbackward: {number(back * 1e3 / iterations)} ms.")
    info("caffe.cpp:408", f"Average Forward pass: {number(sum(forward) * 1e3 / iterations)} ms.")
    info("caffe.cpp:410", f"Average Backward pass: {number(sum(backward) * 1e3 / iterations)} ms.")
    info("caffe.cpp:412", f"Average Forward-Backward: {number(total / iterations)} ms.")
    info("caffe.cpp:414", f"Total Time: {number(total)} ms.")
    info("caffe.cpp:415", "*** Benchmark ends ***")


def time_forward(net: Net, iterations: int) -> None:
    """Run ``iterations`` forward passes of a net that an engine runs as a whole, and log their milliseconds.

    The inputs of the net are zeros.
    """
    inputs = {name: torch.zeros(net.shapes[name]) for name in net.inputs}
    with torch.no_grad():
        info("caffe.cpp:351", "Performing Forward")
        info("caffe.cpp:356", f"Initial loss: {number(float(net.forward_loss(**inputs)[0]))}")
        total = _milliseconds(iterations, "forward", lambda: net(**inputs))
    info("caffe.cpp:408", f"Average Forward pass: {number(total / iterations)} ms.")
    info("caffe.cpp:414", f"Total Time: {number(total)} ms.")
    info("caffe.cpp:415", "*** Benchmark ends ***")


def _milliseconds(iterations: int, what: str, run: Callable[[], object]) -> float:
    """Call a function ``iterations`` times. Log the time of each call, and return the total."""
    info("caffe.cpp:365", "*** Benchmark begins ***")
    info("caffe.cpp:366", f"Testing for {iterations} iterations.")
    began = time.perf_counter()
    for k in range(1, iterations + 1):
        start = time.perf_counter()
        run()
        info("caffe.cpp:394", f"Iteration: {k} {what} time: {number((time.perf_counter() - start) * 1e3)} ms.")
    return (time.perf_counter() - began) * 1e3


def _pass(net: Net, forward: list[float], backward: list[float]) -> float:
    """Run each layer forward, then each backward on its own graph; return the loss. The inputs are zeros.

    The seconds of layer i are added to ``forward[i]`` and ``backward[i]``.
    """
    given = {name: torch.zeros(net.shapes[name], device=net.device) for name in net.inputs}
    wanted = net.backward_plan.bottoms  # for each layer, which of them get a gradient
    made: list[tuple[Step, list[torch.Tensor], tuple[torch.Tensor, ...]]] = []

    def visit(step: Step, bottoms: list[torch.Tensor]) -> tuple[torch.Tensor, ...]:
        asked = zip(bottoms, wanted[step.node] or [False] * len(bottoms), strict=True)  # an input has none
        leaves = [x.detach().requires_grad_(want and x.is_floating_point()) for x, want in asked]
        tops, seconds = _seconds(step.run, leaves)
        forward[step.node] += seconds
        made.append((step, leaves, tops))
        return tops

    loss = walk(net.eager.one_by_one(), net.input_tensors(given), net.options.exact, visit)
    gradients: dict[int, torch.Tensor] = {}
    for step, leaves, tops in reversed(made):
        weights = {loss.top: loss.weight for loss in step.losses if loss.learns}
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
    net.zero_grad()
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
