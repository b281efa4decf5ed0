"""The state of a training: its settings, its nets, its history and its progress.

Caffe: src/caffe/solver.cpp (Solver::Init); the sites in the log calls are the lines of that file that print the same.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import torch

from netspec import log
from netspec.errors import SpecError, Where
from netspec.layers.contract.context import device_of
from netspec.net.build import build_filtered, check_sources
from netspec.net.net import Net
from netspec.net.weights import MOST_BYTES, binary_bytes, load_weights, too_large
from netspec.proto.binary import check_readable, split_paths
from netspec.proto.forks import forks
from netspec.proto.schema import SolverParameter
from netspec.proto.source_map import Position
from netspec.proto.text import write_text
from netspec.solver import nets, update
from netspec.solver.blocks import Blocks
from netspec.solver.checks import (
    bad_parameter,
    bad_top,
    check_prefix,
    check_settings,
    dependence,
    fields_without_effect,
)
from netspec.solver.debug import debug_info
from netspec.solver.options import TrainingOptions, choose_device
from netspec.solver.precision import BF16, FP16, FP32, LossScale, computing, has_bfloat16
from netspec.solver.processes import own_device
from netspec.solver.replicas import Replicas
from netspec.solver.testing import Blobs, Outputs

_CREATING = {
    "net": ("solver.cpp:102", "Creating training net from {}"),
    "net_param": ("solver.cpp:97", "Creating training net specified in {}."),
    "train_net": ("solver.cpp:92", "Creating training net from {}"),
    "train_net_param": ("solver.cpp:88", "Creating training net specified in {}."),
}


class Callback:
    """What a training calls while it runs. A subclass replaces the methods that it needs.

    Caffe: Solver::Callback (include/caffe/solver.hpp), which has the first two
    """

    def on_start(self) -> None:
        """Called before the passes of each iteration."""

    def on_gradients_ready(self) -> None:
        """Called between the passes of an iteration and its update."""

    def on_iteration(self) -> None:
        """Called after the update of an iteration, which is counted then."""

    def on_test(self, net: int) -> None:
        """Called after a test of the test net with this number; its scores are in ``scores`` of the solver."""

    def on_snapshot(self, model: str) -> None:
        """Called after a snapshot, with the path of the weights."""


class Training:
    """The nets, options and progress of a training, which all parts of a solver share.

    ``iteration`` is the number of updates done. ``net`` is the training net, and ``test_nets`` are the others.
    ``scores`` has the mean of each output element in the last test of each test net. ``callbacks`` are called in their
    order. ``last_snapshot`` is the path of the last state of this run, or "".
    """

    param: Any
    node: Position
    options: TrainingOptions
    callbacks: list[Callback]

    net: Net
    test_nets: list[Net]
    count_of_tests: int  # only the root process has test nets
    replicas: Replicas
    blocks: Blocks

    iteration = 0
    current_step = 0
    stopped = False
    last_snapshot = ""
    losses: deque[float]
    losses_before: tuple[float, ...] = ()  # from before a training was resumed
    _reported_nan = False

    def __init__(self, param: Any, node: Position | None = None, options: TrainingOptions | None = None) -> None:
        """Build the nets of a solver from ``proto.text.parse_solver``. Raises SpecError."""
        self.param, self.node, self.options = param, node or Position(Where("<solver>")), options or TrainingOptions()
        self.callbacks = []
        check_settings(param, self.node)
        if param.snapshot and self.is_root:
            check_prefix(param, self.node)
        check_readable(self._weights())
        with log.held_back() as lines:  # report missing files before Caffe's log, which is long
            filtered = [described.filtered() for described in nets.solver_nets(param, self.node)]
            for part in filtered if self.is_root else filtered[:1]:
                check_sources(part.net, part.source, self.options.build)
        self.devices = self._chosen_devices()
        self.device = self.devices[0]
        log.dump("solver.cpp:45", "Initializing solver from parameters: ", write_text(param).rstrip("\n"))
        log.write(lines)
        self.seed = self._chosen_seed()
        self.rule = update.RULES[param.type]
        self.scores: list[Outputs] = []
        self.losses: deque[float] = deque(maxlen=param.average_loss)
        self._build_nets(*filtered)
        self._check_size()
        self._warn_of_settings()
        self.blocks = Blocks(self.net.learnable, self.rule.sets)
        self.scale = LossScale(self.options.precision)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse to be copied or pickled. Raises TypeError."""
        raise TypeError("a Solver cannot be copied or pickled; use snapshot() and load_solver(snapshot=...)")

    @property
    def is_root(self) -> bool:
        """Whether this process tests and takes snapshots."""
        return self.options.processes.is_root

    @property
    def history(self) -> list[torch.Tensor]:
        """The history of each learnable parameter, set after set."""
        return self.blocks.history

    @property
    def loss(self) -> float:
        """The training loss, a mean over the last ``average_loss`` iterations of this call of :meth:`step`."""
        return sum(self.losses) / len(self.losses) if self.losses else 0.0

    def _chosen_devices(self) -> Sequence[torch.device]:
        """Return the devices to train on, and log them as Caffe's tool does."""
        given = [device_of(each) for each in self.options.devices]
        devices = given or [choose_device(self.param, self.node)]
        if not given and self.options.processes.count > 1 and devices[0].type == "cuda":
            devices = [own_device()]
        if devices[0].type == "cpu":
            log.info("caffe.cpp:197", "Use CPU.")
        else:
            log.info("caffe.cpp:204", "Using GPUs " + ", ".join(str(d.index or 0) for d in devices))
        return devices

    def _chosen_seed(self) -> int:
        given = self.options.processes.seed if self.options.build.seed is None else self.options.build.seed
        drawn = int.from_bytes(os.urandom(4), "little") if given is None else given
        return self.param.random_seed if self.param.random_seed >= 0 else drawn

    def _build_nets(self, train: nets.SolverNet, *tests: nets.SolverNet) -> None:
        site, sentence = _CREATING[train.origin.split()[0]]
        log.info(site, sentence.format(train.origin))
        processes, others = self.options.processes, self.devices[1:]
        rank, ranks = processes.rank, processes.count * (1 + len(others))
        self.net = self.build(train, f"rank {rank}" if rank else train.label, self.device, rank, ranks)
        with log.silent():  # Caffe logs only the root
            replicas = [self.build(train, f"rank {k}", other, k, ranks) for k, other in enumerate(others, 1)]
        self.replicas = Replicas(self.net, replicas, processes)
        self.test_nets = []
        self.count_of_tests = len(tests)
        for i, test in enumerate(tests if processes.is_root else ()):
            log.info("solver.cpp:190", f"Creating test net (#{i}) specified by {test.origin}")
            self.test_nets.append(self.build(test, test.label, self.device))

    def build(self, filtered: nets.SolverNet, role: str, device: torch.device, rank: int = 0, ranks: int = 1) -> Net:
        """Build a net and load the weights to start from.

        Each ``role`` has its own random numbers, except for the records: nets that train in parallel share their order.
        """
        options = replace(
            self.options.build,
            device=str(device),
            seed=nets.seed_of(self.seed, role),
            data_seed=self.seed if ranks > 1 else None,
            rank=rank,
            ranks=ranks,
            exact=self.options.exact_sums,
            accumulate_in_place=True,
            passes=(),
        )
        log.write(filtered.lines)
        net = build_filtered(filtered.net, filtered.source, options)
        files = self._weights()
        for path in files:
            log.info("solver.cpp:72", f"Finetuning from {path}")
        if files:
            load_weights(net, files, self.options.build.strict)
        return net

    def _weights(self) -> list[str]:
        """Return the paths of the weights to start from."""
        return [path for paths in self.param.weights for path in split_paths(paths)]

    def _check_size(self) -> None:
        """Raise SpecError at the start if a snapshot would be too large to write."""
        writes = self.param.snapshot or self.param.snapshot_after_train
        if not writes or self.param.snapshot_format == SolverParameter.SnapshotFormat.Value("HDF5"):
            return
        history = self.rule.sets * sum(item.parameter.nbytes for item in self.net.learnable)
        size = max(binary_bytes(self.net, self.param.snapshot_diff), history)
        if size > MOST_BYTES:
            message = f"a snapshot cannot be written: {too_large(size)}"
            raise SpecError(message, self.node.find("snapshot_format"))

    def _warn_of_settings(self) -> None:
        """Warn of fields without effect, and of settings that make the training slow or dependent on the machine."""
        tested = [layer for net in self.test_nets for layer in net.layers]
        read = forks().rates.fields.union(*(own.reads for layer in tested if (own := layer.scorer())))
        for line in fields_without_effect(self.param, self.node, read):
            log.warning("solver.cpp:45", line)
        if said := dependence(self.net, torch.get_num_threads()):
            log.info("solver.cpp:57", said)
        if self.options.precision == FP16 and self.device.type == "cpu":
            log.logger.warning("precision fp16 is slow on CPUs; use bf16 on CPUs that support it")
        if self.options.precision == BF16 and self.device.type == "cpu" and has_bfloat16() is False:
            log.logger.warning("precision bf16: this CPU has no instructions for it, so it is slower than fp32")

    def run(self, net: Net, learns: bool = False) -> tuple[torch.Tensor, Blobs]:
        """Run a net forward, and backward if it ``learns``; return its loss and outputs."""
        if not learns:
            return net.forward_loss()
        if self.options.precision == FP32 and (done := net.forward_backward()):
            return done
        with computing(self.options.precision, self.device):
            loss, outputs = net.forward_loss()
        if loss.requires_grad:
            self.scale.of(loss).backward()
        return loss, outputs

    def debugged(self, net: Net) -> AbstractContextManager[None]:
        """Log the runs of a net within the block, as for ``debug_info``."""
        return debug_info(net)

    def check_inputs(self) -> None:
        """Raise SpecError if a net has inputs, since a training has no values for them."""
        for net in (self.net, *self.test_nets):
            for fault in net.missing_inputs():
                raise fault

    def is_due(self, interval: int) -> bool:
        """Return whether the iteration is a multiple of ``interval``; False for 0."""
        return interval > 0 and self.iteration % interval == 0

    def report_nan(self, what: str) -> None:
        """Raise SpecError or warn, with the location of the NaN or infinity."""
        found = bad_parameter(self.net)
        if not found and self.options.nan == "stop":
            found = bad_top(self.net, self.param.iter_size, f"iteration {self.iteration}")
        first = f"; the first NaN or infinity is in {found}" if found else ""
        message = f"Iteration {self.iteration}: {what}{first}"
        if self.options.nan == "stop":
            kept = f"; the last good snapshot is {self.last_snapshot}" if self.last_snapshot else ""
            raise SpecError(f"{message}{kept}; lower base_lr, or continue with --nan warn", self.node.where)
        if not self._reported_nan:
            log.logger.warning(f"{message}; the training continues")
        self._reported_nan = True

    def close(self) -> None:
        """Close the files and stop the threads of all nets."""
        for net in (self.net, *self.test_nets):
            net.close()
        self.replicas.close()
