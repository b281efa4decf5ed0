"""Tests of a training: the test nets with its weights.

Caffe: Solver::TestAll, Solver::Test (src/caffe/solver.cpp)
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch

from netspec import log
from netspec.net.net import Net
from netspec.solver.debug import debug_info
from netspec.solver.extra import running_state
from netspec.solver.resuming import Resumable
from netspec.solver.tally import Outputs, Tally, score_lines, scorers


class Tested(Resumable):
    """A training that tests its nets, and may take a snapshot meanwhile."""

    def test_all(self) -> None:
        """Run every test net for its test_iter batches with the current weights."""
        self.scores = [{} for _ in self.test_nets]
        self.states_before_test = tuple(running_state(net) for net in self.test_nets)
        for i in range(len(self.test_nets)):
            if not self.stopped:
                self._test(i)
        self.states_before_test = ()

    @torch.no_grad()
    def _test(self, i: int) -> None:
        log.info("solver.cpp:347", f"Iteration {self.iteration}, Testing net (#{i})")
        net, batches = self.test_nets[i], self.param.test_iter[i]
        net.share_weights_with(self.net)
        net.random.begin(f"test at iteration {self.iteration}")
        tally = Tally(scorers(net, self.param))
        for _ in range(batches):
            while self.options.processes.count == 1 and (
                request := self.options.action()
            ):  # several agree after an iteration
                if request == "snapshot":
                    self.snapshot()
                self.stopped |= request == "stop"
            if self.stopped:
                log.info("solver.cpp:396", "Test interrupted.")
                return
            with self.debugged(net) if self.param.debug_info else nullcontext():
                tally.add(*self.test_pass(net))
        if self.param.test_compute_loss and batches:
            log.info("solver.cpp:401", f"Test loss: {log.number(tally.loss)}")
        self.scores[i] = tally.scores
        log_scores("solver.cpp:414", "Test", self.scores[i], net.output_loss_weights)
        self.on_test(i)

    def test_pass(self, net: Net) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run a net forward; return its loss and outputs."""
        return net.forward_loss()

    def debugged(self, net: Net) -> AbstractContextManager[None]:
        """Log the passes within the block, as for ``debug_info``."""
        return debug_info(net)


def log_scores(site: str, phase: str, scores: Outputs, weights: dict[str, float]) -> None:
    """Log the outputs of a net as Caffe does; ``phase`` is the word before them."""
    for i, line in enumerate(score_lines(scores, weights)):
        log.info(site, f"    {phase} net output #{i}: {line}")
