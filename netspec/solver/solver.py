"""The training loop. An iteration: clear, [test], forward and backward, rate, update, count, [snapshot].

Caffe: src/caffe/solver.cpp; the sites in the log calls are the lines of that file that print the same.
"""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from netspec.errors import SpecError, Where
from netspec.exact import NONE, SMALL
from netspec.graph.filter import with_train_state
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.net.options import BuildOptions
from netspec.net.segments import missing_tool
from netspec.net.stamp import Stamp
from netspec.net.weights import MOST_BYTES, binary_bytes, load_weights, save_weights, too_large
from netspec.process import waiting
from netspec.process.heap import keep_freed_memory
from netspec.proto.binary import split_paths
from netspec.proto.schema import SolverParameter
from netspec.proto.source_map import Place
from netspec.proto.text import parse_solver, write_text
from netspec.run.training import TrainingStep
from netspec.solver import nets, update
from netspec.solver.blocks import Blocks
from netspec.solver.checks import check_prefix, check_settings, fields_without_effect
from netspec.solver.debug import debug_info
from netspec.solver.extra import (
    Extra,
    check_pair,
    path_beside,
    read_extra,
    resume,
    running_state,
    write_extra,
)
from netspec.solver.lr_policy import learning_rate, next_step
from netspec.solver.nan import bad_parameter, bad_top
from netspec.solver.precision import FP16, FP32, LossScale, check_precision, computing
from netspec.solver.processes import Processes, own_device
from netspec.solver.replicas import Replicas
from netspec.solver.settings import Settings, changes, settings_of
from netspec.solver.snapshot import State, find_learned_net, has_squares, merge_shared, read_state, write_state
from netspec.solver.tally import Outputs, Tally, as_scores, score_lines, scorers
from netspec.solver.threads import dependence, divided_sums
from netspec.terminal import log

_CREATING = {
    "net": ("solver.cpp:102", "Creating training net from {}"),
    "net_param": ("solver.cpp:97", "Creating training net specified in {}."),
    "train_net": ("solver.cpp:92", "Creating training net from {}"),
    "train_net_param": ("solver.cpp:88", "Creating training net specified in {}."),
}


def load_solver(
    path: str | Path,
    weights: str | Path | Iterable[str | Path] | None = None,
    snapshot: str | Path | None = None,
    device: str | torch.device | Sequence[str | torch.device] | None = None,
    level: int | None = None,
    stages: Iterable[str] = (),
    allow_python: bool = False,
    action: Callable[[], str | None] | None = None,
    exact: str = SMALL,
    strict: bool = False,
    precision: str = FP32,
    nan: str = "stop",
    processes: Processes | None = None,
    compiled: bool = False,
) -> Solver:
    """Build the solver of a prototxt and its nets, ready to run.

    ``weights`` (one path, several separated by commas, or several) replaces the solver's own ``weights`` field; with
    ``strict`` they must have every layer of each net. ``snapshot`` is a .solverstate to go on from; ``level`` and
    ``stages`` go to the training net. Several devices train side by side, the first being the root. For ``device``,
    ``action``, ``precision``, ``nan``, ``processes`` and ``compiled`` see :class:`Solver`; each of several processes
    has the GPU of its number on its machine if ``device`` is None. Raises SpecError for every fault of the files.
    """
    if weights is not None and snapshot is not None:
        raise SpecError("give a snapshot to resume training or weights to fine-tune, not both", Where(str(path)))
    param, node = parse_solver(path)
    if level is not None or stages:
        param = with_train_state(param, level, stages)
    if weights is not None:
        param.ClearField("weights")
        param.weights.extend([str(weights)] if isinstance(weights, (str, Path)) else map(str, weights))
    if device is None:
        chosen = [choose_device(param, node)]
        if processes is not None and processes.count > 1 and chosen[0].type == "cuda":
            chosen = [own_device()]
    else:
        chosen = [torch.device(d) for d in ([device] if isinstance(device, (str, torch.device)) else device)]
    if chosen[0].type == "cpu":
        log.info("caffe.cpp:197", "Use CPU.")
    else:
        log.info("caffe.cpp:204", "Using GPUs " + ", ".join(str(d.index or 0) for d in chosen))
    extra = None if snapshot is None else read_extra(snapshot)
    solver = Solver(
        param,
        node,
        device=chosen[0],
        others=chosen[1:],
        seed=None if extra is None else extra.seed,
        allow_python=allow_python,
        exact=exact,
        strict=strict,
        action=action,
        precision=precision,
        nan=nan,
        processes=processes,
        compiled=compiled,
    )
    if snapshot is not None:
        log.info("caffe.cpp:235", f"Resuming from {snapshot}")
        solver.restore(snapshot)
    return solver


def choose_device(param: Any, node: Place) -> torch.device:
    """Return the device set by solver_mode and device_id; the CPU, with a warning, if there is no GPU."""
    if param.solver_mode == SolverParameter.SolverMode.Value("CPU"):
        return torch.device("cpu")
    count = torch.cuda.device_count()
    if not count:
        place = node.find("solver_mode")
        log.warning("caffe.cpp:197", f"{place}: solver_mode GPU, but torch finds no GPU: running on the CPU")
        return torch.device("cpu")
    if not 0 <= param.device_id < count:
        raise SpecError(
            f"found device_id {param.device_id}, but torch finds {count} GPU(s) on this machine", node.find("device_id")
        )
    return torch.device("cuda", param.device_id)


class Solver:
    """A training: the training net, the test nets, and its state.

    ``iteration`` is the number of updates done; ``net`` is the training net, ``test_nets`` the others; ``scores`` has,
    for each test net, the mean of each output element in its last test. ``on_start()`` is called before the passes of
    each iteration, ``on_gradients()`` between them and the update, ``on_iteration()`` after it; ``on_test(i)`` after
    test net i was run, ``on_snapshot(model)`` after weights and state were written, with the path
    of the weights. ``last_snapshot`` is the path of the last state of this run, or "".
    """

    def __init__(
        self,
        param: Any,
        node: Place | None = None,
        *,
        device: torch.device | None = None,
        others: Sequence[torch.device] = (),
        allow_python: bool = False,
        exact: str = SMALL,
        seed: int | None = None,
        strict: bool = False,
        action: Callable[[], str | None] | None = None,
        nan: str = "stop",
        clock: Callable[[], float] = time.perf_counter,
        precision: str = FP32,
        processes: Processes | None = None,
        compiled: bool = False,
    ) -> None:
        """Build the nets of a solver from ``proto.text.parse_solver``. Raises SpecError.

        ``device`` overrides solver_mode and device_id; replicas of the training net run on ``others``. ``seed`` is used
        if there is no random_seed; without it one is drawn. ``action`` is called between iterations, also those of a
        test: "stop" ends the training, "snapshot" takes one. ``nan`` says what a loss of NaN or infinity does: "stop"
        raises SpecError, "warn" warns once. ``clock`` gives the seconds for "iter/s". In another ``precision`` than
        "fp32" (netspec/solver/precision.py) the training net computes no sums in Caffe's order. Of several
        ``processes`` each has one training net and calls the same methods; the root tests and writes the snapshots.
        ``compiled`` nets run through torch.compile (netspec/net/segments.py); they compute no sums in Caffe's order.
        """
        node = node or Place(Where("<solver>"))
        log.dump("solver.cpp:45", "Initializing solver from parameters: ", write_text(param).rstrip("\n"))
        check_settings(param, node)
        self._processes = processes or Processes()
        if param.snapshot and self._processes.is_root:
            check_prefix(param, node)
        self.param = param
        self.node = node
        self.action = action or (lambda: None)
        self.clock = clock
        self.on_start: Callable[[], object] = lambda: None
        self.on_gradients: Callable[[], object] = lambda: None
        self.on_iteration: Callable[[], object] = lambda: None
        self.on_test: Callable[[int], object] = lambda i: None
        self.on_snapshot: Callable[[str], object] = lambda model: None
        self.iteration = 0
        self.current_step = 0
        self.scores: list[Outputs] = []
        self.stopped = False
        self._losses: deque[float] = deque(maxlen=param.average_loss)
        self._losses_before: list[float] = []  # of a training that is resumed
        self._nan, self._told_nan = nan, False
        self.last_snapshot = ""
        self._states_before_test: list[dict[str, Any]] = []
        self._displayed = (clock(), 0)
        self._waited = 0.0
        rule = update.find_rule(param.type)
        assert rule is not None, "check_settings refuses unknown types"
        self._rule = rule
        self._device = device or choose_device(param, node)
        self._allow_python = allow_python
        check_precision(precision)
        self._precision = precision
        self._scale, self._overflowed = LossScale(precision), False
        self._exact = exact if precision == FP32 and not compiled else NONE
        self._compiled = compiled
        self._prepared: TrainingStep | str | None = None  # what trains, or why there is none
        if compiled and (lack := missing_tool(self._device)):
            raise SpecError(f"--compile: {lack}", node.where)
        self._strict = strict
        if seed is None:
            seed = self._processes.seed
        drawn = int.from_bytes(os.urandom(4), "little") if seed is None else seed
        self._seed = param.random_seed if param.random_seed >= 0 else drawn

        train, *tests = nets.solver_nets(param, node)
        site, sentence = _CREATING[train.origin.split()[0]]
        log.info(site, sentence.format(train.origin))
        assert not (others and self._processes.count > 1), "each of several processes has one device"
        rank, ranks = self._processes.rank, self._processes.count * (1 + len(others))
        self.net = self._build(train, f"rank {rank}" if rank else train.label, self._device, rank, ranks)
        with log.silent():  # Caffe logs only the root
            replicas = [self._build(train, f"rank {k}", other, k, ranks) for k, other in enumerate(others, 1)]
        self.replicas = Replicas(self.net, replicas, self._processes)
        self.test_nets: list[Net] = []
        self._tests = len(tests)
        for i, test in enumerate(tests if self._processes.is_root else ()):
            log.info("solver.cpp:190", f"Creating test net (#{i}) specified by {test.origin}")
            self.test_nets.append(self._build(test, test.label, self._device))
        self._check_size()
        read = frozenset[str]().union(*(layer.solver_reads for net in self.test_nets for layer in net.layers))
        for line in fields_without_effect(param, node, read):
            log.warning("solver.cpp:45", line)
        if said := dependence(self.net, torch.get_num_threads()):
            log.info("solver.cpp:57", said)
        if self._device.type == "cpu" and (said := waiting.too_late(torch.get_num_threads())):
            log.info("solver.cpp:57", said)
        if precision == FP16 and self._device.type == "cpu":
            log.logger.warning("precision fp16: CPUs compute it slowly; bf16 is for CPUs")
        log.info("solver.cpp:57", "Solver scaffolding done.")
        self._blocks = Blocks(self.net.learnable, self._rule.sets)
        self.history = self._blocks.history

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse to be copied or pickled. Raises TypeError."""
        raise TypeError("a Solver cannot be copied or pickled: take a snapshot(), and load_solver(snapshot=...) it")

    def _build(self, described: nets.SolverNet, role: str, device: torch.device, rank: int = 0, ranks: int = 1) -> Net:
        """Build a net and load the weights to start from.

        Each ``role`` has its own random numbers, except for the records: nets that train in parallel share their order.
        """
        options = BuildOptions(
            device,
            seed=nets.seed_of(self._seed, role),
            data_seed=self._seed if ranks > 1 else None,
            allow_python=self._allow_python,
            rank=rank,
            ranks=ranks,
            exact=self._exact,
            accumulate_in_place=True,
            passes=(),
            compiled=self._compiled,
        )
        net = build_net(described.net, described.source, options)
        files = [path for paths in self.param.weights for path in split_paths(paths)]
        for path in files:
            log.info("solver.cpp:72", f"Finetuning from {path}")
        if files:
            load_weights(net, files, self._strict)
        return net

    def _check_size(self) -> None:
        """Raise SpecError now, not after days, where a snapshot could not be written."""
        writes = self.param.snapshot or self.param.snapshot_after_train
        if not writes or self.param.snapshot_format == SolverParameter.SnapshotFormat.Value("HDF5"):
            return
        history = self._rule.sets * sum(item.parameter.nbytes for item in self.net.learnable)
        size = max(binary_bytes(self.net, self.param.snapshot_diff), history)
        if size > MOST_BYTES:
            message = f"a snapshot cannot be written: {too_large(size)}"
            raise SpecError(message, self.node.find("snapshot_format"))

    @property
    def loss(self) -> float:
        """The training loss, a mean over the last ``average_loss`` iterations of this call of :meth:`step`."""
        return sum(self._losses) / len(self._losses) if self._losses else 0.0

    @property
    def learning_rate(self) -> float:
        """The rate of the next iteration."""
        return learning_rate(self.param, self.iteration, next_step(self.param, self.iteration, self.current_step))

    def solve(self) -> None:
        """Train up to max_iter, then show the loss and test once more if the settings require it."""
        log.info("solver.cpp:289", f"Solving {self.net.name}")
        log.info("solver.cpp:290", f"Learning Rate Policy: {self.param.lr_policy}")
        if self.param.snapshot_after_train and self._processes.is_root:
            check_prefix(self.param, self.node)
        self.step(self.param.max_iter - self.iteration)
        if self.param.snapshot_after_train and not self._is_due(self.param.snapshot):
            self.snapshot()
        if self.stopped:
            log.info("solver.cpp:311", "Optimization stopped early.")
            return
        if self._is_due(self.param.display):
            with torch.no_grad():
                self._losses.append(self.test_pass(self.net)[0].item())
            log.info("solver.cpp:327", f"Iteration {self.iteration}, loss = {log.number(self.loss)}")
        if self._is_due(self.param.test_interval):
            self.test_all()
        log.info("solver.cpp:332", "Optimization Done.")

    def step(self, iterations: int) -> None:
        """Run some iterations. The window of the averaged loss starts again, unless the training was just resumed.

        Raises SpecError if a net has inputs: a solver cannot fill them.
        """
        self.check_inputs()
        keep_freed_memory()
        self.stopped = False
        self.replicas.begin()
        self._losses.clear()
        self._losses.extend(self._losses_before)
        self._losses_before = []
        self._displayed = (self.clock(), self.iteration)
        self._waited = self._seconds_waited()
        for _ in range(iterations):
            if self._is_due(self.param.test_interval) and (self.iteration > 0 or self.param.test_initialization):
                self.test_all()
                if self.stopped:
                    return
            for net in (self.net, *self.replicas.nets):
                net.random.begin(f"iteration {self.iteration}")
            self.on_start()
            loss, outputs = self._forward_backward()
            self._losses.append(loss)
            if not math.isfinite(loss):
                self._tell_nan(f"the loss is {loss}")
            if self._is_due(self.param.display):
                self._display(outputs)
            self.on_gradients()
            self.apply_update()
            self.on_iteration()
            request = self._processes.agree(self.action())
            if self._is_due(self.param.snapshot) or request == "snapshot":
                self.snapshot()
            if request == "stop":
                self.stopped = True
                return

    def _tell_nan(self, what: str) -> None:
        """Stop, or warn, and say where the NaN or infinity is."""
        found = bad_parameter(self.net)
        if not found and self._nan == "stop":
            found = bad_top(self.net, self.param.iter_size, f"iteration {self.iteration}")
        first = f"; the first NaN or infinity is in {found}" if found else ""
        message = f"Iteration {self.iteration}: {what}{first}"
        if self._nan == "stop":
            kept = f"; the last good snapshot is {self.last_snapshot}" if self.last_snapshot else ""
            raise SpecError(f"{message}{kept}; lower base_lr, or go on with --nan warn", self.node.where)
        if not self._told_nan:
            log.logger.warning(f"{message}; the training goes on")
        self._told_nan = True

    def check_inputs(self) -> None:
        """Raise SpecError where a net has inputs: nobody would fill them."""
        for net in (self.net, *self.test_nets):
            for fault in net.missing_inputs():
                raise fault

    def _is_due(self, interval: int) -> bool:
        return interval > 0 and self.iteration % interval == 0

    def _forward_backward(self) -> tuple[float, dict[str, torch.Tensor]]:
        """Sum the gradients of iter_size passes; return the mean of their losses, and the outputs of the last."""
        self.clear_gradients()
        self.replicas.clear()
        total = np.float32(0)
        outputs: dict[str, torch.Tensor] = {}
        for _ in range(self.param.iter_size):
            wanted = self.param.debug_info and self._is_due(self.param.display)
            with self.debugged(self.net) if wanted else nullcontext():
                loss, outputs = self.train_pass()
            self.replicas.backward(self._precision, self._scale)
            total += np.float32(loss.item())
        self.replicas.reduce()
        if self._precision == FP16:
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
                self._tell_nan("the gradients overflow float16")

    def clear_gradients(self) -> None:
        """Clear the gradients, before an iteration sums them up."""
        self._blocks.clear()

    def train_pass(self) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run the training net forward and backward; return its loss and outputs."""
        if self._prepared is None:
            self._prepared = self.net.training_step() if self._precision == FP32 else "its precision is not fp32"
        if isinstance(self._prepared, TrainingStep) and not self.net.keep and not self._prepared.is_watched():
            loss, outputs = self._prepared.run()
            self.net.__dict__["blobs"] = outputs  # a module's own way of setting is slow
            return loss, outputs
        with computing(self._precision, self._device):
            loss, outputs = self.net.forward_loss()
        if loss.requires_grad:
            self._scale.of(loss).backward()
        return loss, outputs

    def test_pass(self, net: Net) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run a net forward; return its loss and outputs."""
        return net.forward_loss()

    def debugged(self, net: Net) -> AbstractContextManager[None]:
        """Log the passes within the block, as for ``debug_info``."""
        return debug_info(net)

    @torch.no_grad()
    def apply_update(self) -> None:
        """Update the weights and count the iteration; the gradients then contain the subtracted values, as in Caffe.

        In float16 an iteration whose gradients overflowed is counted only.
        """
        rate = self._advance_rate()
        if self._is_due(self.param.display):
            log.info("sgd_solver.cpp:112", f"Iteration {self.iteration}, lr = {log.number(rate)}")
        if self._overflowed:
            self.iteration += 1
            return
        clipped = (
            update.clip(self._blocks.diffs(), self.param.clip_gradients) if self.param.clip_gradients >= 0 else None
        )
        if clipped:
            norm, factor = map(log.number, clipped)
            limit = log.number(self.param.clip_gradients)
            message = f"Gradient clipping: scaling down gradients (L2 norm {norm} > {limit}) by scale factor {factor}"
            log.info("sgd_solver.cpp:99", message)
        self._blocks.move(self._rule, self.param, rate, self.iteration)
        self.replicas.update()
        self.iteration += 1

    def _advance_rate(self) -> float:
        step = next_step(self.param, self.iteration, self.current_step)
        if step != self.current_step and self.param.lr_policy == "multistep":
            log.info("sgd_solver.cpp:50", f"MultiStep Status: Iteration {self.iteration}, step = {step}")
        self.current_step = step
        return learning_rate(self.param, self.iteration, step)

    def _display(self, outputs: dict[str, torch.Tensor]) -> None:
        now, (then, iteration) = self.clock(), self._displayed
        speed = (self.iteration - iteration) / (now - then or 1)
        pace = f"{log.number(speed)} iter/s, {log.number(now - then)}s/{self.param.display} iters"
        log.info("solver.cpp:239", f"Iteration {self.iteration} ({pace}), loss = {log.number(self.loss)}")
        _log_scores("solver.cpp:258", "Train", as_scores(outputs), self.net.output_loss_weights)
        if any(layer.reads_data for layer in self.net.layers):
            waited = self._seconds_waited()
            share = 100 * (waited - self._waited) / (now - then or 1)
            log.info("blocking_queue.cpp:49", f"Waiting for data: {share:.1f} % of the time")
            self._waited = waited
        self._displayed = (now, self.iteration)

    def _seconds_waited(self) -> float:
        return sum(layer.waited for layer in self.net.layers)

    # Testing

    def test_all(self) -> None:
        """Run every test net for its test_iter batches with the current weights."""
        self.scores = [{} for _ in self.test_nets]
        self._states_before_test = [running_state(net) for net in self.test_nets]
        for i in range(len(self.test_nets)):
            if not self.stopped:
                self._test(i)
        self._states_before_test = []

    @torch.no_grad()
    def _test(self, i: int) -> None:
        log.info("solver.cpp:347", f"Iteration {self.iteration}, Testing net (#{i})")
        net, batches = self.test_nets[i], self.param.test_iter[i]
        net.share_weights_with(self.net)
        net.random.begin(f"test at iteration {self.iteration}")
        tally = Tally(scorers(net, self.param))
        for _ in range(batches):
            while self._processes.count == 1 and (request := self.action()):  # several agree after an iteration
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
        _log_scores("solver.cpp:414", "Test", self.scores[i], net.output_loss_weights)
        self.on_test(i)

    # Snapshot and restore

    def snapshot(self) -> tuple[str, str]:
        """Write the weights and the state; return their paths, ``PREFIX_iter_N.caffemodel`` and ``.solverstate``.

        With ``snapshot_format: HDF5`` both end in ``.h5``. Of several processes the root writes them.
        Raises SpecError if they cannot be written.
        """
        if self._nan == "stop" and bad_parameter(self.net):
            self._tell_nan("the weights cannot be saved")
        hdf5 = self.param.snapshot_format == SolverParameter.SnapshotFormat.Value("HDF5")
        form, ending = ("HDF5", ".h5") if hdf5 else ("binary proto", "")
        stem = f"{self.param.snapshot_prefix}_iter_{self.iteration}"
        model, state = f"{stem}.caffemodel{ending}", f"{stem}.solverstate{ending}"
        states = self._running_states()
        if not self._processes.is_root:
            self.last_snapshot = state
            return model, state
        log.info("solver.cpp:474" if hdf5 else "solver.cpp:464", f"Snapshotting to {form} file {model}")
        save_weights(self.net, model, self.param.snapshot_diff)
        site = "sgd_solver.cpp:296" if hdf5 else "sgd_solver.cpp:284"
        log.info(site, f"Snapshotting solver state to {form} file {state}")
        history = [values.cpu().numpy() for values in self.history]
        weights, settings = Stamp.of(model), self._settings()
        write_state(
            state,
            State(self.iteration, model, self.current_step, history),
            before=lambda unfinished: write_extra(
                path_beside(state),
                Extra(self._seed, list(self._losses), states, settings, weights, Stamp.of(unfinished)),
            ),
        )
        self.last_snapshot = state
        self.on_snapshot(model)
        return model, state

    def _running_states(self) -> list[dict[str, dict[str, Any]]]:
        """Return what each net remembers. During a test, test nets' are as before: it is run again after a resume."""
        training = [running_state(net) for net in (self.net, *self.replicas.nets)]
        testing = self._states_before_test or [running_state(net) for net in self.test_nets]
        return [state for states in self._processes.gather(training) for state in states] + testing

    def restore(self, path: str | Path) -> None:
        """Resume from a .solverstate or .solverstate.h5, of Caffe or of netspec, and from its weights.

        With the file ``X.solverstate.extra`` beside it the training goes on as if it had never stopped; without it, as
        in Caffe, the data layers start again at their first record. Raises SpecError, and changes nothing, if the state
        does not fit this solver's type and net.
        """
        where = Where(str(path))
        extra = read_extra(path)
        state = self._of_today(read_state(path), where)
        if len(state.history) != len(self.history):
            found, expected = len(state.history), len(self.history)
            message = (
                f"incorrect length of history blobs: found {found}, expected {expected} for this net and solver type"
            )
            raise SpecError(f"{message} {self.param.type}", where)
        for i, (mine, theirs) in enumerate(zip(self.history, state.history, strict=True)):
            if not _same_shape(tuple(mine.shape), theirs.shape):
                raise SpecError(f"history blob {i} has shape {theirs.shape}, expected {tuple(mine.shape)}", where)
        learned_net = find_learned_net(state, path)
        if extra is not None:
            check_pair(path, learned_net, extra)
        load_weights(self.net, learned_net, strict=True)
        log.info("sgd_solver.cpp:336", "SGDSolver: restoring history")
        for mine, theirs in zip(self.history, state.history, strict=True):
            mine.copy_(torch.tensor(theirs).view(mine.shape))
        self.iteration = state.iteration
        self.current_step = state.current_step
        for net in (self.net, *self.test_nets):
            net.restart_data()
        self.replicas.restart_data()
        if extra is None:
            log.logger.info(f"{path} is Caffe's: the data starts again at its first record, with other random numbers")
        else:
            self._go_on(extra, Where(str(path_beside(path))))

    def _go_on(self, extra: Extra, where: Where) -> None:
        """Go on in the data where a training stopped, with the losses of its average."""
        training, rank = (self.net, *self.replicas.nets), self._processes.rank
        ranks = len(training) * self._processes.count
        if len(extra.nets) != ranks + self._tests:
            expected = f"{ranks} of training and {self._tests} of testing"
            log.logger.warning(f"{where}: is of {len(extra.nets)} nets, not {expected}: the data starts again")
            return
        all_nets = (*training, *self.test_nets)
        remembered = extra.nets[rank : rank + len(training)] + extra.nets[ranks:][: len(self.test_nets)]
        try:
            for net, states in zip(all_nets, remembered, strict=True):
                resume(net, states)
        except SpecError as fault:
            raise SpecError(fault.message, where) from None
        self._losses_before = extra.losses
        if extra.seed != self._seed:
            log.logger.warning(f"{where}: random_seed was {extra.seed}: the random numbers are others from here on")
        elif told := changes(extra.settings, self._settings()):
            log.logger.warning(f"{where}: the training goes on with other numbers: {told}")
        else:
            log.logger.info(f"{where}: the training goes on as if it had never stopped")

    def _settings(self) -> Settings:
        """Return what the numbers of this training follow from."""
        manner: dict[str, Any] = {
            "precision": self._precision,
            "exact": self._exact,
            "compiled": self._compiled,
            "device": self._device.type,
            "torch": torch.__version__,
        }
        if divided_sums(self.net):
            manner["threads"] = torch.get_num_threads()
        tests = {f"test net #{i}": net for i, net in enumerate(self.test_nets)}
        return settings_of(self.param, {nets.TRAIN_NET: self.net, **tests}, manner)

    def _of_today(self, state: State, where: Where) -> State:
        """Return a state in today's form, where it has a history for each layer that shares a parameter."""
        number = {id(learnable.parameter): i for i, learnable in enumerate(self.net.learnable)}
        owners = [number[id(blob)] for layer in self.net.layers for blob in layer.blobs]
        shapes = [shape for layer in self.net.layers for shape in layer.blob_shapes]
        if len(state.history) == len(self.history) or len(state.history) != self._rule.sets * len(owners):
            return state
        if len(state.history) == 2 * len(self.history) and has_squares(state.history, self.param.type):
            return state  # not of this type: the second half is another type's second set
        for i, theirs in enumerate(state.history):
            mine = shapes[i % len(shapes)]
            if not _same_shape(mine, theirs.shape):
                raise SpecError(f"history blob {i} has shape {theirs.shape}, expected {mine}", where)
        told = "has a history for each layer, as before August 2015; those of shared parameters are added up"
        log.warning("sgd_solver.cpp:336", f"{where}: {told}")
        return replace(state, history=merge_shared(state.history, owners))

    def close(self) -> None:
        """Close the files and stop the threads of all nets."""
        for net in (self.net, *self.test_nets):
            net.close()
        self.replicas.close()


def _log_scores(site: str, phase: str, scores: Outputs, weights: dict[str, float]) -> None:
    for i, line in enumerate(score_lines(scores, weights)):
        log.info(site, f"    {phase} net output #{i}: {line}")


def _same_shape(mine: tuple[int, ...], theirs: tuple[int, ...]) -> bool:
    """Return whether two shapes are equal, or theirs is an old shape of four axes, with ones in front."""
    return theirs == mine or theirs == (1,) * (4 - len(mine)) + mine
