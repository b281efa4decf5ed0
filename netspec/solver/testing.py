"""Tests of a training: the test nets with its weights.

Caffe: Solver::TestAll, Solver::Test (src/caffe/solver.cpp)
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import torch

from netspec import log
from netspec.solver.extra import Remembered, running_state
from netspec.solver.tally import Outputs, Tally, score_lines, scorers
from netspec.solver.training import Training


class Tests:
    """The tests of a training. ``states_before`` is what the test nets remembered before the test that runs now."""

    def __init__(self, training: Training) -> None:
        self._training = training
        self.states_before: tuple[Remembered, ...] = ()

    def run(self, snapshot: Callable[[], object]) -> None:
        """Run every test net for its test_iter batches with the current weights; ``snapshot`` is taken on request."""
        training = self._training
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
        for _ in range(batches):
            while training.options.processes.count == 1 and (
                request := training.options.action()
            ):  # several agree after an iteration
                if request == "snapshot":
                    snapshot()
                training.stopped |= request == "stop"
            if training.stopped:
                log.info("solver.cpp:396", "Test interrupted.")
                return
            with training.debugged(net) if param.debug_info else nullcontext():
                tally.add(*training.forward(net))
        if param.test_compute_loss and batches:
            log.info("solver.cpp:401", f"Test loss: {log.number(tally.loss)}")
        training.scores[i] = tally.scores
        log_scores("solver.cpp:414", "Test", tally.scores, net.output_loss_weights)
        training.on_test(i)


def log_scores(site: str, phase: str, scores: Outputs, weights: dict[str, float]) -> None:
    """Log the outputs of a net as Caffe does; ``phase`` is the word before them."""
    for i, line in enumerate(score_lines(scores, weights)):
        log.info(site, f"    {phase} net output #{i}: {line}")
