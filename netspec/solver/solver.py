"""The training loop. An iteration: clear, [test], forward and backward, rate, update, count, [snapshot].

Caffe: src/caffe/solver.cpp; the sites in the log calls are the lines of that file that print the same.
"""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch

from netspec import log
from netspec.errors import SpecError, several
from netspec.graph.filter import with_train_state
from netspec.proto.schema import SolverParameter
from netspec.proto.source_map import Position
from netspec.solver import update
from netspec.solver.checks import bad_parameter
from netspec.solver.extra import Remembered, read_extra, running_state
from netspec.solver.lr_policy import learning_rate, next_step
from netspec.solver.options import TrainingOptions
from netspec.solver.precision import FP16
from netspec.solver.resuming import restore, sole_writer, write_snapshot
from netspec.solver.testing import Blobs, Display, log_scores, test
from netspec.solver.training import Training


def make_solver(
    param: SolverParameter,
    node: Position,
    options: TrainingOptions,
    weights: str | Path | Iterable[str | Path] | None = None,
    snapshot: str | Path | None = None,
) -> Solver:
    """Build a solver from ``proto.text.parse_solver`` and its nets, as ``netspec.load_solver`` does (netspec/load.py).

    If no device is given, each of several processes uses the GPU of its local rank.
    """
    if weights is not None and snapshot is not None:
        raise SpecError("give a snapshot to resume training or weights to fine-tune, not both", node.where)
    if options.build.level is not None or options.build.stages:
        param = with_train_state(param, options.build.level, options.build.stages)
    if weights is not None:
        param.ClearField("weights")
        param.weights.extend(map(str, several(weights)))
    extra = None if snapshot is None else read_extra(snapshot)
    build = options.build if extra is None else replace(options.build, seed=extra.seed)
    solver = Solver(param, node, replace(options, build=build))
    if snapshot is not None:
        log.info("caffe.cpp:235", f"Resuming from {snapshot}")
        solver.restore(snapshot)
    return solver


class Solver(Training):
    """A training: the loop, its updates, tests and snapshots. Only the solver changes its fields."""

    _is_complete = False
    _overflowed = False
    _before_test: tuple[Remembered, ...] = ()  # the running states of the test nets before the current test

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._display = Display(self.net)
        log.info("solver.cpp:57", "Solver scaffolding done.")
        self._is_complete = True

    def __setattr__(self, name: str, value: Any) -> None:
        """Raise AttributeError for a name that no part of a solver reads: the settings are those of ``param``."""
        if self._is_complete and not hasattr(self, name):
            raise AttributeError(f"a Solver has no {name}; its settings are in param, as param.base_lr")
        super().__setattr__(name, value)

    @property
    def learning_rate(self) -> float:
        """The rate of the next iteration."""
        return learning_rate(self.param, self.iteration, next_step(self.param, self.iteration, self.current_step))

    def solve(self) -> None:
        """Train up to max_iter, then log the loss and test again if the settings require it.

        Raises SpecError if another process trains with the same snapshot_prefix (see sole_writer).
        """
        with sole_writer(self):
            self._solve()

    def _solve(self) -> None:
        log.info("solver.cpp:289", f"Solving {self.net.name}")
        log.info("solver.cpp:290", f"Learning Rate Policy: {self.param.lr_policy}")
        self.step(self.param.max_iter - self.iteration)
        if self.param.snapshot_after_train and not self.is_due(self.param.snapshot):
            self.snapshot()
        if self.stopped:
            log.info("solver.cpp:311", "Optimization stopped early.")
            return
        if self.is_due(self.param.display):
            with torch.no_grad():
                self.losses.append(self.run(self.net)[0].item())
            log.info("solver.cpp:327", f"Iteration {self.iteration}, loss = {log.number(self.loss)}")
        if self.is_due(self.param.test_interval):
            self.test_all()
        log.info("solver.cpp:332", "Optimization Done.")

    def step(self, iterations: int) -> None:
        """Run ``n`` iterations. The window of the averaged loss restarts, unless the training was just resumed.

        Ctrl-C raises KeyboardInterrupt at the end of the current iteration, so that a later call can
        continue. A second Ctrl-C raises it at once. Raises SpecError if a net has inputs, since a solver cannot fill
        them.
        """
        self.check_inputs()
        self.stopped = False
        self.replicas.begin()
        self.losses.clear()
        self.losses.extend(self.losses_before)
        self.losses_before = ()
        self._display.begin(self.iteration, self.options.clock)
        with waiting_interrupts() as interrupt:
            for _ in range(iterations):
                self._iterate()
                if self.stopped:
                    return
                interrupt()

    def _iterate(self) -> None:
        """Run one iteration, including the tests before it and the snapshot after it."""
        if self.is_due(self.param.test_interval) and (self.iteration > 0 or self.param.test_initialization):
            self.test_all()
            if self.stopped:
                return
        for net in (self.net, *self.replicas.nets):
            net.random.begin(f"iteration {self.iteration}")
        for callback in self.callbacks:
            callback.on_start()
        loss, outputs = self._accumulate()
        self.losses.append(loss)
        if not math.isfinite(loss):
            self.report_nan(f"the loss is {loss}")
        if self.is_due(self.param.display):
            self._display.show(self.iteration, self.param.display, self.loss, outputs)
        for callback in self.callbacks:
            callback.on_gradients_ready()
        self.apply_update()
        for callback in self.callbacks:
            callback.on_iteration()
        request = self.options.processes.agree(self.options.action())
        if self.is_due(self.param.snapshot) or request == "snapshot":
            self.snapshot()
        if request == "stop":
            self.stopped = True

    def _accumulate(self) -> tuple[float, Blobs]:
        """Sum the gradients of iter_size runs; return the mean of their losses, and the outputs of the last."""
        self.clear_gradients()
        self.replicas.clear()
        total = np.float32(0)
        outputs: Blobs = {}
        for _ in range(self.param.iter_size):
            wanted = self.param.debug_info and self.is_due(self.param.display)
            with self.debugged(self.net) if wanted else nullcontext():
                loss, outputs = self.run(self.net, learns=True)
            self.replicas.backward(self.options.precision, self.scale)
            total += np.float32(loss.item())
        self._reduce()
        return float(total / np.float32(self.param.iter_size)), outputs

    def clear_gradients(self) -> None:
        """Clear the gradients before an iteration."""
        self.blocks.clear()

    def _reduce(self) -> None:
        """Make the gradients the mean over all devices, without the loss scale.

        If one has overflowed float16, this iteration will not update anything.
        """
        self.replicas.reduce()
        if self.options.precision != FP16:
            return
        gradients = [item.parameter.grad for item in self.net.learnable if item.parameter.grad is not None]
        self._overflowed = not self.scale.remove(gradients)
        if self._overflowed:
            factor = log.number(self.scale.factor)
            log.info("sgd_solver.cpp:99", f"Iteration {self.iteration}: float16 overflowed; loss scale {factor}")
            if self.scale.factor < 1:
                self.report_nan("the gradients overflow float16")

    def apply_update(self) -> None:
        """Update the weights and count the iteration. The gradients then contain the subtracted values, as in Caffe.

        If the gradients overflowed, only count the iteration.
        Caffe: SGDSolver::ApplyUpdate, SGDSolver::GetLearningRate (src/caffe/solvers/sgd_solver.cpp)
        """
        param, step = self.param, next_step(self.param, self.iteration, self.current_step)
        if step != self.current_step and param.lr_policy == "multistep":
            log.info("sgd_solver.cpp:50", f"MultiStep Status: Iteration {self.iteration}, step = {step}")
        rate, self.current_step = learning_rate(param, self.iteration, step), step
        if self.is_due(param.display):
            log.info("sgd_solver.cpp:112", f"Iteration {self.iteration}, lr = {log.number(rate)}")
        if not self._overflowed:
            with torch.no_grad():
                if param.clip_gradients >= 0 and (clipped := update.clip(self.blocks.diffs(), param.clip_gradients)):
                    norm, factor = map(log.number, clipped)
                    found = f"L2 norm {norm} > {log.number(param.clip_gradients)}"
                    message = f"Gradient clipping: scaling down gradients ({found}) by scale factor {factor}"
                    log.info("sgd_solver.cpp:99", message)
                for piece in self.blocks.pieces(rate, param.weight_decay):
                    update.move(self.rule, param, piece, self.iteration)
                self.replicas.update()
        self.iteration += 1

    def test_all(self) -> None:
        """Run every test net for its test_iter batches with the current weights."""
        if not self.is_root:
            return
        self.scores = [{} for _ in self.test_nets]
        self._before_test = tuple(map(running_state, self.test_nets))
        for i in range(len(self.test_nets)):
            if not self.stopped:
                self._test(i)
        self._before_test = ()

    def _test(self, i: int) -> None:
        log.info("solver.cpp:347", f"Iteration {self.iteration}, Testing net (#{i})")
        net, batches, param = self.test_nets[i], self.param.test_iter[i], self.param
        net.share_weights_with(self.net)
        net.random.begin(f"test at iteration {self.iteration}")
        with self.debugged(net) if param.debug_info else nullcontext():
            tally = test(net, batches, lambda: self.run(net), self._stops_test, param)
        if tally is None:
            log.info("solver.cpp:396", "Test interrupted.")
            return
        if param.test_compute_loss and batches:
            log.info("solver.cpp:401", f"Test loss: {log.number(tally.loss)}")
        self.scores[i] = tally.scores
        log_scores("solver.cpp:414", "Test", tally.scores, net.output_loss_weights)
        for callback in self.callbacks:
            callback.on_test(i)

    def _stops_test(self) -> bool:
        """Take a snapshot if that is requested; return whether to stop. Several processes agree after an iteration."""
        while self.options.processes.count == 1 and (request := self.options.action()):
            if request == "snapshot":
                self.snapshot()
            self.stopped |= request == "stop"
        return self.stopped

    def snapshot(self) -> tuple[str, str]:
        """Write the weights and the state; return their paths. Raises SpecError (see write_snapshot)."""
        if self.options.nan == "stop" and bad_parameter(self.net):
            self.report_nan("the weights cannot be saved")
        model, state = write_snapshot(self, self._before_test or tuple(map(running_state, self.test_nets)))
        self.last_snapshot = state
        if self.is_root:
            for callback in self.callbacks:
                callback.on_snapshot(model)
        return model, state

    def restore(self, path: str | Path) -> None:
        """Resume from a .solverstate or .solverstate.h5. Raises SpecError (see netspec/solver/resuming.py)."""
        progress = restore(self, path)
        self.iteration, self.current_step = progress.iteration, progress.current_step
        self.losses_before = progress.losses


@contextmanager
def waiting_interrupts() -> Iterator[Callable[[], None]]:
    """Delay Ctrl-C within the block. The yielded function raises KeyboardInterrupt if Ctrl-C was pressed.

    So does the end of the block. A second Ctrl-C raises it immediately. In threads other than the main one, and if the
    program has its own handler, nothing is delayed.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: None
        return
    received: list[int] = []

    def wait(number: int, frame: FrameType | None) -> None:
        if received:
            signal.default_int_handler(number, frame)
        received.append(number)

    def interrupt() -> None:
        if received:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, wait)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    interrupt()
