"""Checks a net or solver: its shapes, parameters, memory and multiply-adds, and all of its errors at once.

It finds all errors that would stop a training before its first iteration. No file is written, and data is opened only
on request. All unknown fields are reported, together with the errors in other layers; a layer with an unknown field is
not checked further. For syntax errors, and for errors in the settings of one layer, only the first is
reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from netspec import log
from netspec.errors import ForkFault, SpecError
from netspec.export.formats.inputs import wrong_given_shapes
from netspec.files.limits import memory
from netspec.graph.filter import with_state, with_train_state
from netspec.graph.options import BuildOptions
from netspec.inspect.check import net_rules, solver_rules  # noqa: F401, they register their rules
from netspec.inspect.check.findings import NET, PLAN, SETTINGS, SOLVER, TEXT, Finding, findings, not_ignored
from netspec.inspect.check.forks import gathered, others, python_layers, unknown_types
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.net.weights import load_weights
from netspec.proto.binary import split_paths
from netspec.proto.schema import TEST, NetParameter, PhaseValue, SolverParameter
from netspec.proto.source_map import Position, SourceMap
from netspec.proto.text import parse_net, parse_solver
from netspec.solver.checks import check_prefix, check_settings
from netspec.solver.nets import TRAIN_NET, seed_of, solver_nets
from netspec.solver.options import choose_device


@dataclass
class Checked:
    """The result for one net of the file, named by ``label``. ``advice`` lists probable mistakes.

    The result for a solver itself comes first. Its label is the path of the file, and it has no net.
    """

    label: str
    net: Net | None
    faults: list[SpecError] = field(default_factory=list)
    advice: list[Finding] = field(default_factory=list)


ON_META = BuildOptions("meta", open_data=False, passes=())  # shapes only, and no data is opened


def check_file(
    path: str | Path, phase: PhaseValue = TEST, options: BuildOptions = ON_META, weights: str | None = None
) -> list[Checked]:
    """Check a net for a phase, level and stages; or a solver and all its nets (level and stages: the training net's).

    ``weights`` are paths separated by commas, for the start of a training; they replace those of the solver. A file
    that cannot be read gives one result without a net. On a device other than "meta" a net gets memory, as
    :func:`netspec.inspect.check.plan.plan_text` needs it.
    """
    given = [weights] if weights else []
    unknown: list[SpecError] = []
    try:
        net, source = parse_net(path, report=unknown.append)
    except SpecError as as_net:
        of_solver: list[SpecError] = []
        try:
            solver, node = parse_solver(path, report=of_solver.append)
        except SpecError as as_solver:
            last = max([*unknown, as_net], [*of_solver, as_solver], key=_reach)
            return [Checked(str(path), None, gathered(last))]
        solver = with_train_state(solver, options.level, options.stages)
        return _check_solver(solver, node, path, given or solver.weights, options, of_solver)
    if unknown:  # the build finds unknown types itself, but not after something that it cannot build
        unknown += _unknown_layers(net, source, options)
    net = with_state(net, phase, options.level, options.stages)
    checked = _check_net(net, source, str(path), [] if unknown else given, options)
    checked.faults = gathered([*unknown, *others(checked.faults, unknown)])
    checked.faults += wrong_given_shapes(options.given_shapes, [net], path)
    return [checked]


def _unknown_layers(net: NetParameter, source: SourceMap, options: BuildOptions) -> list[SpecError]:
    return [*unknown_types(net, source), *([] if options.allow_python else python_layers(net, source))]


def _reach(faults: Sequence[SpecError]) -> tuple[int, int]:
    """Read a file as a net and as a solver; return the result that got further."""
    where = faults[-1].where
    return (where.line, where.column) if where else (0, 0)


def _check_net(
    net: NetParameter, source: SourceMap, label: str, weights: Iterable[str], options: BuildOptions, seed: int = 0
) -> Checked:
    """Build a net (its ``state`` set) without memory, check weights against it, and collect the errors."""
    faults: list[SpecError] = []
    built = build_net(net, source.reporting_to(faults.append), replace(options, seed=seed))
    if fault := built.need.fault(memory() if options.limit is None else options.limit):
        faults.append(fault)
    if files := [path for paths in weights for path in split_paths(paths)]:
        load_weights(built, files, options.strict)
    advice = [*findings(TEXT, net, source), *findings(PLAN, net, source, built.plan)]
    advice += [] if faults else findings(NET, built)
    return Checked(label, built, faults, not_ignored(advice, source.file, source.layers))


def _check_solver(
    solver: SolverParameter,
    node: Position,
    path: str | Path,
    weights: Iterable[str],
    options: BuildOptions,
    faults: list[SpecError],
) -> list[Checked]:
    """Check a solver and its nets; ``faults`` are those of its text, to which others are added."""
    check_settings(solver, node, faults.append)
    if (solver.snapshot > 0 and solver.snapshot_prefix) or solver.snapshot_after_train:
        check_prefix(solver, node, faults.append, try_it=False)
    try:
        with log.silent():
            choose_device(solver, node)
    except SpecError as fault:
        faults.append(fault)
    described = solver_nets(solver, node, faults.append)
    unknown: list[SpecError] = [fault for fault in faults if isinstance(fault, ForkFault)]
    if unknown:
        unknown += [fault for part in described for fault in _unknown_layers(part.net, part.source, options)]
        weights = []
    faults += wrong_given_shapes(options.given_shapes, [part.net for part in described], path)
    parts = [
        _check_net(part.net, part.source, part.label, weights, options, seed_of(max(solver.random_seed, 0), part.label))
        for part in described
    ]
    nets = [part.net for part in parts if part.net is not None]
    if described and described[0].label == TRAIN_NET:
        for net in nets[1:]:
            net.share_weights_with(nets[0])
    for part in parts:
        part.faults = others(part.faults, unknown)
    faults = gathered([*faults, *unknown])
    advice = [] if faults else findings(SETTINGS, solver, node)
    if not faults and not any(part.faults for part in parts):
        advice += findings(SOLVER, solver, node, nets)
    return [Checked(str(path), None, faults, not_ignored(advice, str(path))), *parts]


def as_json(net: Net) -> dict[str, Any]:
    """Return ``blobs`` name -> shape, ``params`` layer -> shapes, ``inputs``, ``outputs`` of a net."""
    layers = zip(net.plan.nodes, net.layers, strict=True)
    params = {node.name: [list(shape) for shape in layer.blob_shapes] for node, layer in layers if layer.blob_shapes}
    blobs = {name: list(shape) for name, shape in net.shapes.items()}
    return {"blobs": blobs, "params": params, "inputs": net.inputs, "outputs": net.outputs}
