"""The public functions :func:`load_net` and :func:`load_solver`, which build a net or a solver from files.

A net for another engine comes from the optional package netspec/export.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from netspec.errors import SpecError, several
from netspec.graph.options import FP32, PASSES, TORCH, BuildOptions
from netspec.graph.speed import speed
from netspec.proto.schema import phase_of

if TYPE_CHECKING:
    import torch

    from netspec.net.net import Net
    from netspec.solver.solver import Solver


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
    """Build the net of a prototxt for a phase, level and stages, with weights from one or several files.

    - ``passes``: the optimizations of a net of phase TEST that runs without gradients (netspec/fast/steps.py).
    - ``exact``: which sums are bit-identical to Caffe's: "none", "small" or "all" (netspec/exact/__init__.py).
    - ``strict``: layers without weights in the files are an error. By default there is a warning.
    - ``engine``: "torch", "onnxruntime" or "openvino" (docs/engines.md).
    - ``precision``: "fp32", or "bf16" if the engine supports it.
    - ``cache``: the folder for exported models. None: the user's cache folder. False: no folder.
    - ``limit``: the maximum memory of the net in bytes. None: the memory of its device.

    The other keywords are those of :class:`~netspec.graph.options.BuildOptions`. Raises SpecError for errors in the
    files and for unknown choices.

        >>> net = netspec.load_net("deploy.prototxt", weights="x.caffemodel")
        >>> net(images)["prob"].shape
        torch.Size([2, 4])
    """
    from netspec.net.build import build_file
    from netspec.net.weights import load_weights

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
    choice = None
    if (engine, precision) != (TORCH, FP32):
        if find_spec("netspec.export") is None:
            raise SpecError(f'engine "{engine}" needs netspec/export, which is not installed')
        from netspec.export.engines.choice import Choice

        choice = Choice.of(engine, precision, cache)
    net = build_file(path, phase_of(phase), options)
    if files:
        load_weights(net, files, strict)
    if choice is None:
        return net
    from netspec.export.engines.net import with_engine

    return with_engine(net, choice, path, files)


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

    - ``weights``: one path, paths separated by commas, or several paths. They replace the solver's ``weights`` field.
    - ``strict``: the weights must contain every layer of each net.
    - ``snapshot``: a .solverstate from which to resume.
    - ``device``: one device, or several that train in parallel. The first is the root.
    - ``level``, ``stages``: the state of the training net.

    The other keywords are those of :class:`~netspec.solver.options.TrainingOptions` and
    :class:`~netspec.graph.options.BuildOptions`. Raises SpecError for errors in the files and for unknown choices.

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
