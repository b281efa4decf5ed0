"""The public doors, :func:`load_net` and :func:`load_solver`: from files to a net, and to a solver.

Here alone a net is given what is not in the core: speed (netspec/fast), and another engine (netspec/export/engines).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from netspec.errors import SpecError, several
from netspec.graph.options import FP32, PASSES, TORCH, BuildOptions
from netspec.proto.schema import phase_of

if TYPE_CHECKING:
    import torch

    from netspec.fast.speed import Fast
    from netspec.net.net import Net
    from netspec.solver.solver import Solver


def speed() -> Fast | None:
    """Return netspec/fast for :class:`~netspec.graph.options.BuildOptions`, or None if it is not installed."""
    if find_spec("netspec.fast") is None:
        return None
    from netspec.fast.speed import Fast

    return Fast()


def load_net(
    path: str | Path,
    phase: str | int = "TEST",
    weights: str | Path | Iterable[str | Path] | None = None,
    level: int = 0,
    stages: str | Iterable[str] = (),
    device: str | torch.device = "cpu",
    seed: int | None = None,
    allow_python: bool = False,
    exact: str = BuildOptions.exact,
    strict: bool = False,
    passes: str | Collection[str] = PASSES,
    engine: str = TORCH,
    precision: str = FP32,
    cache: str | Path | bool | None = None,
    limit: int | None = None,
) -> Net:
    """Build the net of a prototxt for a phase, level and stages; ``weights`` names one file of weights or several.

    It takes what a user may choose as keywords; from here on that is one BuildOptions (netspec/graph/options.py).
    A warning names the layers that the weights lack; with ``strict`` that is an error.
    ``passes`` are what may speed up a net of phase TEST that runs without gradients (netspec/fast/steps.py).
    ``exact`` says which sums are Caffe's to the last bit: "none", "small" or "all" (see netspec/exact/__init__.py).
    ``engine`` is "torch", "onnxruntime" or "openvino" (docs/engines.md), ``precision`` "fp32", or "bf16" where the
    engine has it, ``cache`` the folder that keeps exported models (None: the user's cache folder, False: none).
    ``limit`` is the memory, in bytes, that the net may need (None: what there is).
    Raises SpecError for every fault of the files.

        >>> net = netspec.load_net("deploy.prototxt", weights="x.caffemodel")
        >>> net(images)["prob"].shape
        torch.Size([2, 4])
    """
    from netspec.net import build

    options = BuildOptions(
        str(device),
        seed,
        level=level,
        stages=several(stages),
        allow_python=allow_python,
        exact=exact,
        speed=speed(),
        passes=several(passes),
        strict=strict,
        limit=limit,
    )
    files = several(weights)
    if (engine, precision) == (TORCH, FP32):
        return build.load_net(path, phase_of(phase), options, files)
    if find_spec("netspec.export") is None:
        raise SpecError(f'engine "{engine}" needs netspec/export, which is not installed')
    from netspec.export.engines.choice import Choice
    from netspec.export.engines.net import with_engine

    choice = Choice.of(engine, precision, cache)
    return with_engine(build.load_net(path, phase_of(phase), options, files), choice, path, files)


def load_solver(
    path: str | Path,
    weights: str | Path | Iterable[str | Path] | None = None,
    snapshot: str | Path | None = None,
    device: str | torch.device | Sequence[str | torch.device] | None = None,
    level: int | None = None,
    stages: str | Iterable[str] = (),
    allow_python: bool = False,
    action: Callable[[], str | None] = lambda: None,
    exact: str = BuildOptions.exact,
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
    from netspec.proto.text import parse_solver
    from netspec.solver.options import TrainingOptions
    from netspec.solver.solver import make_solver

    build = BuildOptions(
        level=level,
        stages=several(stages),
        allow_python=allow_python,
        exact=exact,
        speed=speed(),
        strict=strict,
        limit=limit,
    )
    options = TrainingOptions(build, several(device), nan, precision, action=action)
    return make_solver(*parse_solver(path), options, weights, snapshot)
