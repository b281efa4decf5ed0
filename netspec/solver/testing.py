"""The output of a training: tests, and a display every ``display`` iterations.

Caffe: Solver::TestAll, Solver::Test, Solver::Step (src/caffe/solver.cpp), test() (tools/caffe.cpp)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import torch

from netspec import log
from netspec.log import number
from netspec.net.net import Net

Blobs = dict[str, torch.Tensor]  # the outputs of a run, by name
Outputs = dict[str, list[float]]  # the elements of each output
Scorer = Callable[[Sequence[torch.Tensor]], list[float]]


def scorers(net: Net, solver: Any = None) -> dict[str, Scorer]:
    """Return, by output, the function that computes its score from all batches, for layers that define one."""
    makers = {v: layer for node, layer in zip(net.plan.nodes, net.layers, strict=True) for v in node.tops}
    found = [(name, makers[v]) for name, v in net.plan.outputs.items()]
    return {name: partial(own.score, solver=solver) for name, layer in found if (own := layer.scorer())}


class Tally:
    """Sums the losses and outputs of batches; ``loss`` and ``scores`` are their means so far.

    Outputs in ``scorers`` are kept instead, and scored together. An output whose size changes has no mean.
    """

    def __init__(self, scorers: Mapping[str, Scorer] | None = None) -> None:
        self.batches = 0
        self._loss = 0.0
        self._sums: dict[str, list[float] | None] = {}  # None: its size has changed
        self._scorers = dict(scorers or {})
        self._gathered: dict[str, list[torch.Tensor]] = {name: [] for name in self._scorers}

    def add(self, loss: torch.Tensor, outputs: Mapping[str, torch.Tensor]) -> Outputs:
        """Add the result of ``Net.forward_loss`` for a batch; return the scores of the batch."""
        self.batches += 1
        self._loss += loss.item()
        for name, gathered in self._gathered.items():
            gathered.append(outputs[name].detach())
        batch = as_scores({name: blob for name, blob in outputs.items() if name not in self._scorers})
        for name, values in batch.items():
            sums = self._sums.setdefault(name, [0.0] * len(values))
            if sums is None or len(sums) == len(values):
                self._sums[name] = sums and [a + b for a, b in zip(sums, values, strict=True)]
            else:
                self._sums[name] = None
                sizes = f"{len(values):,} values in batch {self.batches}, and {len(sums):,} before"
                log.warning("solver.cpp:414", f'output "{name}" has {sizes}; its mean is not computed')
        return batch

    @property
    def loss(self) -> float:
        """The mean loss; NaN without a batch (``test_iter: 0``), as Caffe's division by zero."""
        return self._loss / self.batches if self.batches else math.nan

    @property
    def scores(self) -> Outputs:
        """The mean of each element of each output blob, then the scores of outputs in ``scorers``."""
        means = {
            name: [value / self.batches for value in values]
            for name, values in self._sums.items()
            if values is not None
        }
        return means | {name: self._scorers[name](tops) for name, tops in self._gathered.items() if tops}


def as_scores(outputs: Mapping[str, torch.Tensor]) -> Outputs:
    """Return the elements of each output blob, in order."""
    return {name: blob.detach().reshape(-1).tolist() for name, blob in outputs.items()}


def score_lines(scores: Outputs, weights: Mapping[str, float]) -> Iterator[str]:
    """Yield ``name = value`` of each element, with its contribution to the loss if its output has a loss weight."""
    for name, values in scores.items():
        weight = weights[name]
        for value in values:
            ending = f" (* {number(weight)} = {number(weight * value)} loss)" if weight else ""
            yield f"{name} = {number(value)}{ending}"


@torch.no_grad()
def test(
    net: Net, batches: int, forward: Callable[[], tuple[torch.Tensor, Blobs]], stops: Callable[[], bool], param: Any
) -> Tally | None:
    """Run ``forward`` for each batch and return the sums; None if ``stops`` says so before one of them.

    ``param`` is the solver's message, which some scores depend on.
    """
    tally = Tally(scorers(net, param))
    for _ in range(batches):
        if stops():
            return None
        tally.add(*forward())
    return tally


def log_scores(site: str, phase: str, scores: Outputs, weights: dict[str, float]) -> None:
    """Log the outputs of a net as Caffe does; ``phase`` is the first word."""
    for i, line in enumerate(score_lines(scores, weights)):
        log.info(site, f"    {phase} net output #{i}: {line}")


class Display:
    """Logs the speed, the loss, the outputs, and the time that a net waited for data."""

    def __init__(self, net: Net) -> None:
        self._net = net
        self._reads = bool(net.data_layers)

    def begin(self, iteration: int, clock: Callable[[], float]) -> None:
        """Start the clock."""
        self._clock = clock
        self._time, self._iteration, self._waited = clock(), iteration, self._seconds_waited()

    def show(self, iteration: int, interval: int, loss: float, outputs: Blobs) -> None:
        """Log the progress since the last call."""
        now, waited = self._clock(), self._seconds_waited()
        seconds = now - self._time
        speed = (iteration - self._iteration) / (seconds or 1)
        pace = f"{number(speed)} iter/s, {number(seconds)}s/{interval} iters"
        log.info("solver.cpp:239", f"Iteration {iteration} ({pace}), loss = {number(loss)}")
        log_scores("solver.cpp:258", "Train", as_scores(outputs), self._net.output_loss_weights)
        if self._reads:
            share = 100 * (waited - self._waited) / (seconds or 1)
            log.info("blocking_queue.cpp:49", f"Waiting for data: {share:.1f} % of the time")
        self._time, self._iteration, self._waited = now, iteration, waited

    def _seconds_waited(self) -> float:
        return sum(layer.waited for layer in self._net.data_layers)
