"""``caffe.SGDSolver`` and the other solvers.

Caffe: python/caffe/_caffe.cpp, src/caffe/solver.cpp
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, ClassVar

import torch
from typing_extensions import override

from netspec import log
from netspec.compat.pycaffe import mode
from netspec.compat.pycaffe.debug import debug_info
from netspec.compat.pycaffe.errors import caffes_errors
from netspec.compat.pycaffe.net import FilePath, Net
from netspec.graph.options import BuildOptions
from netspec.graph.speed import speed
from netspec.layers.utility.python import Python
from netspec.net import net as core
from netspec.proto.source_map import Position
from netspec.proto.text import parse_solver
from netspec.solver import solver as core_solver
from netspec.solver.options import TrainingOptions
from netspec.solver.training import Callback
from netspec.solver.update import rule_faults

Outputs = dict[str, torch.Tensor]


class _Training(core_solver.Solver):
    """A training that fills the memory of the nets' blobs whenever a script could read it.

    ``is_watched``: blobs are filled in every iteration, because callbacks or Python layers may read them, or because a
    pass reads what a script wrote to them.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.shown = {net: Net.of(net) for net in (self.net, *self.test_nets)}
        self.net.largest_trained = math.inf  # blobs keep all tops anyway
        self.is_watched = bool(self.net.inputs) or any(
            isinstance(layer, Python) or any(top is not None for top in layer.filled_once())
            for layer in self.net.layers
        )

    @override
    def check_inputs(self) -> None:
        """Do nothing: the inputs of a net are the contents of its input blobs."""

    @override
    def clear_gradients(self) -> None:
        """Set the gradients to 0 in place, so that views of them stay valid."""
        self.shown[self.net].runner.upload()
        super().clear_gradients()

    @override
    def forward_backward(self, to_come: int) -> tuple[torch.Tensor, Outputs]:
        """Run forward and backward. The blobs are filled in the last pass of several, and if ``is_watched``."""
        runner = self.shown[self.net].runner
        is_seen = not to_come or self.is_watched or self.param.debug_info
        if not is_seen and (passed := self.net.forward_backward()):
            return passed
        loss, outputs = self.forward(self.net)
        runner.backward(len(self.net.layers) - 1, 0)
        return loss, outputs

    @override
    def forward(self, net: core.Net) -> tuple[torch.Tensor, Outputs]:
        shown = self.shown[net]
        loss = shown.runner.forward(0, len(net.layers) - 1)
        blobs = {name: shown.blobs[name] for name in shown.outputs}
        return loss, {name: blob.data_memory.tensor(blob.shape) for name, blob in blobs.items()}

    @override
    def debugged(self, net: core.Net) -> AbstractContextManager[None]:
        return debug_info(self.shown[net].runner)

    @override
    def apply_update(self) -> None:
        """Update the weights. Scripts may have written to the values and gradients."""
        self.shown[self.net].runner.upload()
        super().apply_update()

    @override
    def snapshot(self) -> tuple[str, str]:
        """Write a snapshot. Scripts may have written to the values."""
        self.shown[self.net].runner.upload()
        return super().snapshot()


class _Functions(Callback):
    """Two functions of a script."""

    def __init__(self, on_start: Callable[[], object], on_gradients_ready: Callable[[], object]) -> None:
        self._on_start, self._on_gradients_ready = on_start, on_gradients_ready

    @override
    def on_start(self) -> None:
        self._on_start()

    @override
    def on_gradients_ready(self) -> None:
        self._on_gradients_ready()


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
        with caffes_errors():
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
        with caffes_errors():
            self._training.solve()

    def step(self, iterations: int) -> None:
        """Run a number of iterations."""
        with caffes_errors():
            self._training.step(int(iterations))

    def restore(self, state_file: FilePath) -> None:
        """Restore the state of a .solverstate, and its weights."""
        self.net.runner.upload()
        self._training.restore(os.fsdecode(state_file))

    def snapshot(self) -> None:
        """Write the weights and the state to files named by snapshot_prefix."""
        self._training.snapshot()

    def share_weights(self, net: Net) -> None:
        """Make a net use the training net's weights."""
        net.share_with(self.net)

    def apply_update(self) -> None:
        """Update the weights with the current gradients. Count an iteration if it is not counted yet."""
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
        self._training.is_watched = True
        if on_gradients_ready is None:
            functions = _Functions(on_start.on_start, on_start.on_gradients_ready)
        else:
            functions = _Functions(on_start, on_gradients_ready)
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
