"""The training loop. An iteration: clear, [test], forward and backward, rate, update, count, [snapshot].

Caffe: src/caffe/solver.cpp; the sites in the log calls are the lines of that file that print the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from netspec import log
from netspec.errors import SpecError, Where, several
from netspec.exact import SMALL
from netspec.graph.filter import with_train_state
from netspec.graph.options import BuildOptions
from netspec.layers.contract.context import device_of
from netspec.layers.contract.reading import Waits, reads_data
from netspec.proto.text import parse_solver
from netspec.solver import update
from netspec.solver.checks import check_prefix
from netspec.solver.extra import read_extra
from netspec.solver.lr_policy import learning_rate, next_step
from netspec.solver.options import TrainingOptions, choose_device
from netspec.solver.precision import FP16, FP32, LossScale, computing
from netspec.solver.processes import own_device
from netspec.solver.tally import as_scores
from netspec.solver.testing import Tested, log_scores


def load_solver(
    path: str | Path,
    weights: str | Path | Iterable[str | Path] | None = None,
    snapshot: str | Path | None = None,
    device: str | torch.device | Sequence[str | torch.device] | None = None,
    level: int | None = None,
    stages: str | Iterable[str] = (),
    allow_python: bool = False,
    action: Callable[[], str | None] = lambda: None,
    exact: str = SMALL,
    strict: bool = False,
    precision: str = FP32,
    nan: str = "stop",
    limit: int | None = None,
) -> Solver:
    """Build the solver of a prototxt and its nets, ready to run.

    ``weights`` (one path, several separated by commas, or several) replaces the solver's own ``weights`` field; with
    ``strict`` they must have every layer of each net. ``snapshot`` is a .solverstate to go on from; ``level`` and
    ``stages`` go to the training net. Several devices train side by side, the first being the root. For the others see
    :class:`~netspec.solver.options.TrainingOptions` and :class:`~netspec.graph.options.BuildOptions`, which all of this
    is from here on. Raises SpecError for every fault of the files.

        >>> solver = netspec.load_solver("solver.prototxt", weights="x.caffemodel")
        >>> solver.step(2)
        >>> solver.iteration
        2
    """
    build = BuildOptions(
        level=level,
        stages=several(stages),
        allow_python=allow_python,
        exact=exact,
        strict=strict,
        limit=limit,
    )
    options = TrainingOptions(build, [device_of(each) for each in several(device)], nan, precision, action=action)
    return make_solver(path, options, weights, snapshot)


def make_solver(
    path: str | Path,
    options: TrainingOptions,
    weights: str | Path | Iterable[str | Path] | None = None,
    snapshot: str | Path | None = None,
) -> Solver:
    """Build a solver as :func:`load_solver` does.

    Where no device is given, each of several processes has the GPU of its number on its machine.
    """
    if weights is not None and snapshot is not None:
        raise SpecError("give a snapshot to resume training or weights to fine-tune, not both", Where(str(path)))
    param, node = parse_solver(path)
    if options.build.level is not None or options.build.stages:
        param = with_train_state(param, options.build.level, options.build.stages)
    if weights is not None:
        param.ClearField("weights")
        param.weights.extend(map(str, several(weights)))
    devices = options.devices or [choose_device(param, node)]
    if not options.devices and options.processes.count > 1 and devices[0].type == "cuda":
        devices = [own_device()]
    if devices[0].type == "cpu":
        log.info("caffe.cpp:197", "Use CPU.")
    else:
        log.info("caffe.cpp:204", "Using GPUs " + ", ".join(str(d.index or 0) for d in devices))
    extra = None if snapshot is None else read_extra(snapshot)
    build = options.build if extra is None else replace(options.build, seed=extra.seed)
    solver = Solver(param, node, replace(options, build=build, devices=devices))
    if snapshot is not None:
        log.info("caffe.cpp:235", f"Resuming from {snapshot}")
        solver.restore(snapshot)
    return solver


class Solver(Tested):
    """A training: the training net, the test nets, and its state (see Training for what it has)."""

    _displayed = (0.0, 0)
    _waited = 0.0
    _overflowed = False

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._scale = LossScale(self.options.precision)
        self._waiting = [layer for layer in self.net.layers if isinstance(layer, Waits)]

    @property
    def learning_rate(self) -> float:
        """The rate of the next iteration."""
        return learning_rate(self.param, self.iteration, next_step(self.param, self.iteration, self.current_step))

    def solve(self) -> None:
        """Train up to max_iter, then show the loss and test once more if the settings require it."""
        log.info("solver.cpp:289", f"Solving {self.net.name}")
        log.info("solver.cpp:290", f"Learning Rate Policy: {self.param.lr_policy}")
        if self.param.snapshot_after_train and self.options.processes.is_root:
            check_prefix(self.param, self.node)
        self.step(self.param.max_iter - self.iteration)
        if self.param.snapshot_after_train and not self.is_due(self.param.snapshot):
            self.snapshot()
        if self.stopped:
            log.info("solver.cpp:311", "Optimization stopped early.")
            return
        if self.is_due(self.param.display):
            with torch.no_grad():
                self.losses.append(self.test_pass(self.net)[0].item())
            log.info("solver.cpp:327", f"Iteration {self.iteration}, loss = {log.number(self.loss)}")
        if self.is_due(self.param.test_interval):
            self.test_all()
        log.info("solver.cpp:332", "Optimization Done.")

    def step(self, iterations: int) -> None:
        """Run some iterations. The window of the averaged loss starts again, unless the training was just resumed.

        Raises SpecError if a net has inputs: a solver cannot fill them.
        """
        self.check_inputs()
        self.stopped = False
        self.replicas.begin()
        self.losses.clear()
        self.losses.extend(self.losses_before)
        self.losses_before = ()
        self._displayed = (self.options.clock(), self.iteration)
        self._waited = self._seconds_waited()
        for self.to_come in reversed(range(iterations)):
            if self.is_due(self.param.test_interval) and (self.iteration > 0 or self.param.test_initialization):
                self.test_all()
                if self.stopped:
                    return
            for net in (self.net, *self.replicas.nets):
                net.random.begin(f"iteration {self.iteration}")
            self.on_start()
            loss, outputs = self._forward_backward()
            self.losses.append(loss)
            if not math.isfinite(loss):
                self.tell_nan(f"the loss is {loss}")
            if self.is_due(self.param.display):
                self._display(outputs)
            self.on_gradients()
            self.apply_update()
            self.on_iteration()
            request = self.options.processes.agree(self.options.action())
            if self.is_due(self.param.snapshot) or request == "snapshot":
                self.snapshot()
            if request == "stop":
                self.stopped = True
                return

    def _forward_backward(self) -> tuple[float, dict[str, torch.Tensor]]:
        """Sum the gradients of iter_size passes; return the mean of their losses, and the outputs of the last."""
        self.clear_gradients()
        self.replicas.clear()
        total = np.float32(0)
        outputs: dict[str, torch.Tensor] = {}
        for _ in range(self.param.iter_size):
            wanted = self.param.debug_info and self.is_due(self.param.display)
            with self.debugged(self.net) if wanted else nullcontext():
                loss, outputs = self.train_pass()
            self.replicas.backward(self.options.precision, self._scale)
            total += np.float32(loss.item())
        self.replicas.reduce()
        if self.options.precision == FP16:
            self._unscale()
        return float(total / np.float32(self.param.iter_size)), outputs

    def _unscale(self) -> None:
        """Take the loss scale off the gradients; where one has overflowed, this iteration will update nothing."""
        gradients = [item.parameter.grad for item in self.net.learnable if item.parameter.grad is not None]
        self._overflowed = not self._scale.remove(gradients)
        if self._overflowed:
            factor = log.number(self._scale.factor)
            log.info("sgd_solver.cpp:99", f"Iteration {self.iteration}: float16 overflowed; loss scale {factor}")
            if self._scale.factor < 1:
                self.tell_nan("the gradients overflow float16")

    def clear_gradients(self) -> None:
        """Clear the gradients, before an iteration sums them up."""
        self.blocks.clear()

    def train_pass(self) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run the training net forward and backward; return its loss and outputs."""
        if self.options.precision == FP32 and (passed := self.net.train_pass()):
            return passed
        with computing(self.options.precision, self.device):
            loss, outputs = self.net.forward_loss()
        if loss.requires_grad:
            self._scale.of(loss).backward()
        return loss, outputs

    @torch.no_grad()
    def apply_update(self) -> None:
        """Update the weights and count the iteration; the gradients then contain the subtracted values, as in Caffe.

        In float16 an iteration whose gradients overflowed is counted only.
        """
        rate = self._advance_rate()
        if self.is_due(self.param.display):
            log.info("sgd_solver.cpp:112", f"Iteration {self.iteration}, lr = {log.number(rate)}")
        if self._overflowed:
            self.iteration += 1
            return
        clipped = (
            update.clip(self.blocks.diffs(), self.param.clip_gradients) if self.param.clip_gradients >= 0 else None
        )
        if clipped:
            norm, factor = map(log.number, clipped)
            limit = log.number(self.param.clip_gradients)
            message = f"Gradient clipping: scaling down gradients (L2 norm {norm} > {limit}) by scale factor {factor}"
            log.info("sgd_solver.cpp:99", message)
        for piece in self.blocks.pieces(rate, self.param.weight_decay):
            update.move(self.rule, self.param, piece, self.iteration)
        self.replicas.update()
        self.iteration += 1

    def _advance_rate(self) -> float:
        step = next_step(self.param, self.iteration, self.current_step)
        if step != self.current_step and self.param.lr_policy == "multistep":
            log.info("sgd_solver.cpp:50", f"MultiStep Status: Iteration {self.iteration}, step = {step}")
        self.current_step = step
        return learning_rate(self.param, self.iteration, step)

    def _display(self, outputs: dict[str, torch.Tensor]) -> None:
        now, (then, iteration) = self.options.clock(), self._displayed
        speed = (self.iteration - iteration) / (now - then or 1)
        pace = f"{log.number(speed)} iter/s, {log.number(now - then)}s/{self.param.display} iters"
        log.info("solver.cpp:239", f"Iteration {self.iteration} ({pace}), loss = {log.number(self.loss)}")
        log_scores("solver.cpp:258", "Train", as_scores(outputs), self.net.output_loss_weights)
        if any(reads_data(layer) for layer in self.net.layers):
            waited = self._seconds_waited()
            share = 100 * (waited - self._waited) / (now - then or 1)
            log.info("blocking_queue.cpp:49", f"Waiting for data: {share:.1f} % of the time")
            self._waited = waited
        self._displayed = (now, self.iteration)

    def _seconds_waited(self) -> float:
        return sum(layer.waited for layer in self._waiting)
