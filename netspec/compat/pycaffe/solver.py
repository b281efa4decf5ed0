"""``caffe.SGDSolver`` and the other solvers.

Caffe: python/caffe/_caffe.cpp, src/caffe/solver.cpp
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cached_property
from typing import Any, ClassVar

import torch
from typing_extensions import override

from netspec import log
from netspec.compat.pycaffe import mode
from netspec.compat.pycaffe.debug import debug_info
from netspec.compat.pycaffe.errors import unwrapped_errors
from netspec.compat.pycaffe.net import FilePath, Net
from netspec.graph.options import BuildOptions
from netspec.graph.speed import speed
from netspec.net import net as core
from netspec.proto.source_map import Position
from netspec.proto.text import parse_solver
from netspec.solver import solver as core_solver
from netspec.solver.options import TrainingOptions
from netspec.solver.training import Callback
from netspec.solver.update import rule_faults

Outputs = dict[str, torch.Tensor]


class _Training(core_solver.Solver):
    """A training whose nets run through the memory of their blobs."""

    @cached_property
    def shown(self) -> dict[core.Net, Net]:
        """The nets as scripts see them."""
        return {net: Net.of(net) for net in (self.net, *self.test_nets)}

    @override
    def check_inputs(self) -> None:
        """Do nothing: the inputs of a net are the contents of its input blobs."""

    @override
    def run(self, net: core.Net, learns: bool = False) -> tuple[torch.Tensor, Outputs]:
        shown, last = self.shown[net], len(net.layers) - 1
        loss = shown.runner.forward(0, last)
        if learns:
            shown.runner.backward(last, 0)
        blobs = {name: shown.blobs[name] for name in shown.outputs}
        return loss, {name: blob.data_memory.tensor(blob.shape) for name, blob in blobs.items()}

    @override
    def debugged(self, net: core.Net) -> AbstractContextManager[None]:
        return debug_info(self.shown[net].runner)


class _Functions(Callback):
    """Two functions of a script. What they write to learnable blobs counts."""

    def __init__(self, net: Net, on_start: Callable[[], object], on_gradients_ready: Callable[[], object]) -> None:
        self._net, self._on_start, self._on_gradients_ready = net, on_start, on_gradients_ready

    @override
    def on_start(self) -> None:
        self._on_start()
        self._net.runner.upload()

    @override
    def on_gradients_ready(self) -> None:
        self._on_gradients_ready()
        self._net.runner.upload()


class Solver:
    """A training, from a solver's prototxt: ``get_solver(file)``, or ``SGDSolver(file)`` for any type in the file.

    The blobs of ``net`` and ``test_nets`` have the content of the last iteration; the diffs of parameters are the
    updates that it subtracted. Raises SpecError (a ValueError) for every fault of the files.
    """

    type_name: ClassVar[str] = ""

    def __init_subclass__(cls, type_name: str = "") -> None:
        cls.type_name = type_name or cls.type_name

    def __init__(self, solver_file: FilePath) -> None:
        param, node = parse_solver(os.fsdecode(solver_file))
        if self.type_name:
            param.type = self.type_name
        self._build(param, node)

    def _build(self, param: Any, node: Position) -> None:
        with unwrapped_errors():
            build = BuildOptions(seed=mode.next_seed(), allow_python=True, exact=mode.exact(), speed=speed())
            # nan: the training continues, as in Caffe; a script may check the loss itself
            options = TrainingOptions(build, [mode.device()], nan="warn")
            self._training = _Training(param, node, options)
        self._counted = False

    @property
    def net(self) -> Net:
        """The training net."""
        return self._training.shown[self._training.net]

    @property
    def test_nets(self) -> list[Net]:
        """The test nets; they share the training net's weights from the first test on."""
        return [self._training.shown[net] for net in self._training.test_nets]

    @property
    def iter(self) -> int:
        """The number of updates so far."""
        return self._training.iteration

    @property
    def param(self) -> Any:
        """The settings, a SolverParameter. Changes take effect in the next iteration."""
        return self._training.param

    @property
    def lr(self) -> float:
        """The learning rate of the next iteration."""
        return self._training.learning_rate

    def solve(self, resume_file: FilePath | None = None) -> None:
        """Train up to max_iter, starting from a .solverstate if one is given."""
        if resume_file:
            log.info("solver.cpp:296", f"Restoring previous solver status from {os.fsdecode(resume_file)}")
            self.restore(resume_file)
        self.net.runner.upload()
        with unwrapped_errors():
            self._training.solve()

    def step(self, iterations: int) -> None:
        """Run a number of iterations."""
        self.net.runner.upload()
        with unwrapped_errors():
            self._training.step(int(iterations))

    def restore(self, state_file: FilePath) -> None:
        """Restore the state of a .solverstate, and its weights."""
        self.net.runner.upload()
        self._training.restore(os.fsdecode(state_file))

    def snapshot(self) -> None:
        """Write the weights and the state to files named by snapshot_prefix."""
        self.net.runner.upload()
        self._training.snapshot()

    def share_weights(self, net: Net) -> None:
        """Make a net use the training net's weights."""
        net.share_with(self.net)

    def apply_update(self) -> None:
        """Update the weights with the current gradients. Count an iteration if it is not counted yet."""
        self.net.runner.upload()
        self._training.apply_update()
        self._training.iteration -= self._counted
        self._counted = False

    def increment_iter(self) -> None:
        """Count an iteration before its update, as Dosovitskiy's fork (deepsim, DCGAN) does."""
        self._training.iteration += 1
        self._counted = True

    def add_callback(self, on_start: Any, on_gradients_ready: Callable[[], object] | None = None) -> None:
        """Call two functions in each iteration: before its passes, and between them and the update.

        An object with the methods ``on_start`` and ``on_gradients_ready`` may replace both.
        """
        if on_gradients_ready is None:
            functions = _Functions(self.net, on_start.on_start, on_start.on_gradients_ready)
        else:
            functions = _Functions(self.net, on_start, on_gradients_ready)
        self._training.callbacks.append(functions)


class SGDSolver(Solver, type_name="SGD"):
    """Stochastic gradient descent with momentum."""


class NesterovSolver(Solver, type_name="Nesterov"):
    """Nesterov's accelerated gradient."""


class AdaGradSolver(Solver, type_name="AdaGrad"):
    """AdaGrad."""


class RMSPropSolver(Solver, type_name="RMSProp"):
    """RMSProp."""


class AdaDeltaSolver(Solver, type_name="AdaDelta"):
    """AdaDelta."""


class AdamSolver(Solver, type_name="Adam"):
    """Adam."""


_SOLVERS = (SGDSolver, NesterovSolver, AdaGradSolver, RMSPropSolver, AdaDeltaSolver, AdamSolver)


def get_solver(solver_file: FilePath) -> Solver:
    """Return a solver of the type in the file."""
    param, node = parse_solver(os.fsdecode(solver_file))
    for fault in rule_faults(param, node):
        raise fault
    named = {cls.type_name: cls for cls in _SOLVERS}
    cls = named[param.type]
    solver = cls.__new__(cls)
    solver._build(param, node)
    return solver
