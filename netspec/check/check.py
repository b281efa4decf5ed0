"""What a file builds, without opening any data: shapes, parameters, memory, multiply-adds; and every fault at once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from netspec.check.lint import missing_data, net_advice, solver_advice
from netspec.errors import SpecError, Where, did_you_mean
from netspec.graph.filter import with_state, with_train_state
from netspec.layers.base import Shape
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.net.options import BuildOptions
from netspec.proto.text import parse_net, parse_solver


@dataclass
class Checked:
    """One net of the file: ``label`` says which; ``advice`` is about what is legal but likely wrong.

    A solver whose settings are faulty comes first, under its own path and without a net.
    """

    label: str
    net: Net | None
    faults: list[SpecError] = field(default_factory=list)
    advice: list[str] = field(default_factory=list)


def is_solver(path: str | Path) -> bool:
    """Return whether a file is a solver's rather than a net's: whichever reads further into it."""
    try:
        parse_net(path)
        return False
    except SpecError as as_net:
        try:
            parse_solver(path)
            return True
        except SpecError as as_solver:
            return _reach(as_solver) > _reach(as_net)


def _reach(fault: SpecError) -> tuple[int, int]:
    return (fault.where.line, fault.where.column) if fault.where else (0, 0)


def check_net(net: Any, source: Any, label: str, shapes: Mapping[str, Shape], allow_python: bool = False) -> Checked:
    """Build a net (its ``state`` set) on no device and collect its faults."""
    faults: list[SpecError] = []
    options = BuildOptions(
        torch.device("meta"), 0, open_data=False, given_shapes=shapes, report=faults.append, allow_python=allow_python
    )
    built = build_net(net, source, options)
    advice = [*missing_data(net, built.param, source), *(() if faults else net_advice(built))]
    return Checked(label, built, faults, advice)


def check_file(
    path: str | Path,
    phase: int,
    level: int = 0,
    stages: Iterable[str] = (),
    shapes: Mapping[str, Shape] | None = None,
    allow_python: bool = False,
) -> list[Checked]:
    """Check a net for a phase, level and stages, or all nets of a solver."""
    given = shapes or {}
    if is_solver(path):
        return _check_solver(path, level, stages, given, allow_python)
    net, source = parse_net(path)
    checked = check_net(with_state(net, phase, level, stages), source, str(path), given, allow_python)
    checked.faults.extend(_not_to_be_given(given, [net], path))
    return [checked]


def _not_to_be_given(shapes: Mapping[str, Shape], nets: Sequence[Any], path: str | Path) -> list[SpecError]:
    """Return a fault for each given shape of a blob that no data layer (or Python layer) makes."""
    makers = [layer for net in nets for layer in net.layer if not layer.bottom or layer.type == "Python"]
    blobs = list(dict.fromkeys(top for layer in makers for top in layer.top))
    known = ", ".join(blobs) or "none"
    return [
        SpecError(
            f'--shape names "{name}"{did_you_mean(name, blobs) or ";"} the blobs of data layers: {known}',
            Where(str(path)),
        )
        for name in shapes
        if name not in blobs
    ]


def _check_solver(
    path: str | Path, level: int, stages: Iterable[str], shapes: Mapping[str, Shape], allow_python: bool
) -> list[Checked]:
    from netspec.solver.checks import check_settings
    from netspec.solver.nets import solver_nets

    solver, node = parse_solver(path)
    faults: list[SpecError] = []
    check_settings(solver, node, faults.append)
    try:
        described = solver_nets(with_train_state(solver, level, stages), node)
    except SpecError as fault:
        faults.append(fault)
        described = []
    checked = [check_net(part.net, part.source, part.label, shapes, allow_python) for part in described]
    if described:
        faults += _not_to_be_given(shapes, [part.net for part in described], path)
    if faults:
        return [Checked(str(path), None, faults), *checked]
    nets = [part.net for part in checked if part.net is not None and not part.faults]
    if len(nets) == len(checked):
        checked[0].advice.extend(solver_advice(solver, node, nets))
    return checked
