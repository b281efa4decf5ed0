"""The output of a training: tests, and a display every ``display`` iterations.

Caffe: Solver::TestAll, Solver::Test, Solver::Step (src/caffe/solver.cpp), test() (tools/caffe.cpp)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

import torch

from netspec import log
from netspec.log import number
from netspec.net.net import Net
from netspec.solver.extra import Remembered, running_state
from netspec.solver.training import Blobs, Outputs, Training

Scorer = Callable[[Sequence[torch.Tensor]], list[float]]


def scorers(net: Net, solver: Any = None) -> dict[str, Scorer]:
    """Return, by output, the function that computes its score from all batches, for layers that define one."""
    makers = {v: layer for node, layer in zip(net.plan.nodes, net.layers, strict=True) for v in node.tops}
    found = [(name, makers[v]) for name, v in net.plan.outputs.items()]
    return {name: partial(layer.score, solver=solver) for name, layer in found if layer.scores_tests}


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
        """The mean loss."""
        return self._loss / self.batches

    @property
    def scores(self) -> Outputs:
        """The mean of each element of each output blob, then the scores of outputs in ``scorers``."""
        means = {
            name: [value / self.batches for value in values]
            for name, values in self._sums.items()
            if values is not None
        }
        return means | {name: score(self._gathered[name]) for name, score in self._scorers.items()}


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


class Tests:
    """The tests of a training. ``states_before`` is the state of the test nets before the current test."""

    def __init__(self, training: Training) -> None:
        self._training = training
        self.states_before: tuple[Remembered, ...] = ()

    def run(self, snapshot: Callable[[], object]) -> None:
        """Run every test net for its test_iter batches with the current weights; ``snapshot`` is taken on request."""
        training = self._training
        if not training.is_root:
            return
        training.scores = [{} for _ in training.test_nets]
        self.states_before = tuple(running_state(net) for net in training.test_nets)
        for i in range(len(training.test_nets)):
            if not training.stopped:
                self._run(i, snapshot)
        self.states_before = ()

    @torch.no_grad()
    def _run(self, i: int, snapshot: Callable[[], object]) -> None:
        training = self._training
        log.info("solver.cpp:347", f"Iteration {training.iteration}, Testing net (#{i})")
        net, batches, param = training.test_nets[i], training.param.test_iter[i], training.param
        net.share_weights_with(training.net)
        net.random.begin(f"test at iteration {training.iteration}")
        tally = Tally(scorers(net, param))
        is_alone = training.options.processes.count == 1  # several processes agree after an iteration
        for _ in range(batches):
            while is_alone and (request := training.options.action()):
                if request == "snapshot":
                    snapshot()
                training.stopped |= request == "stop"
            if training.stopped:
                log.info("solver.cpp:396", "Test interrupted.")
                return
            with training.debugged(net) if param.debug_info else nullcontext():
                tally.add(*training.forward(net))
        if param.test_compute_loss and batches:
            log.info("solver.cpp:401", f"Test loss: {number(tally.loss)}")
        training.scores[i] = tally.scores
        log_scores("solver.cpp:414", "Test", tally.scores, net.output_loss_weights)
        for callback in training.callbacks:
            callback.on_test(i)


def log_scores(site: str, phase: str, scores: Outputs, weights: dict[str, float]) -> None:
    """Log the outputs of a net as Caffe does; ``phase`` is the first word."""
    for i, line in enumerate(score_lines(scores, weights)):
        log.info(site, f"    {phase} net output #{i}: {line}")


class Display:
    """Logs the speed, the loss, the outputs, and the time that the training waited for data."""

    def __init__(self, training: Training) -> None:
        self._training = training
        self._reads = any(layer.reads_data for layer in training.net.layers)

    def begin(self) -> None:
        """Start the clock."""
        self._time, self._iteration = self._training.options.clock(), self._training.iteration
        self._waited = self._seconds_waited()

    def show(self, outputs: Blobs) -> None:
        """Log the progress since the last call."""
        training = self._training
        now, waited = training.options.clock(), self._seconds_waited()
        seconds = now - self._time
        speed = (training.iteration - self._iteration) / (seconds or 1)
        pace = f"{number(speed)} iter/s, {number(seconds)}s/{training.param.display} iters"
        log.info("solver.cpp:239", f"Iteration {training.iteration} ({pace}), loss = {number(training.loss)}")
        log_scores("solver.cpp:258", "Train", as_scores(outputs), training.net.output_loss_weights)
        if self._reads:
            share = 100 * (waited - self._waited) / (seconds or 1)
            log.info("blocking_queue.cpp:49", f"Waiting for data: {share:.1f} % of the time")
        self._time, self._iteration, self._waited = now, training.iteration, waited

    def _seconds_waited(self) -> float:
        return sum(layer.waited for layer in self._training.net.layers)
