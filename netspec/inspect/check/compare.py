"""Compares the meaning of two nets, two solvers or two weights files. Does not use torch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from netspec.errors import SpecError, Where
from netspec.files.kinds import HDF5, head_of
from netspec.inspect.check.compare_nets import compare_in_state, compare_nets
from netspec.inspect.check.difference import Difference, Differences, differences
from netspec.proto.binary import is_net_binary
from netspec.proto.source_map import Position
from netspec.proto.text import parse_net, parse_solver
from netspec.solver.nets import SolverNet, solver_nets

NET, SOLVER, WEIGHTS = "a net", "a solver", "a file of weights"
_NETS = ("net", "net_param", "train_net", "train_net_param", "test_net", "test_net_param", "train_state", "test_state")


def compare_files(first: str | Path, second: str | Path, tolerance: float = 0.0) -> Differences:
    """Yield the differences between two nets, two solvers or two files of weights.

    ``tolerance`` is for the values of weights. Raises SpecError for files that cannot be read or are of two kinds.
    """
    old, new = _read(first), _read(second)
    if old[0] != new[0]:
        raise SpecError(
            f"is {new[0]}, and {first} is {old[0]}; expected two files of the same kind", Where(str(second))
        )
    if old[0] == WEIGHTS:
        from netspec.inspect.check.compare_weights import compare_weights  # NumPy is not loaded for two prototxts

        return compare_weights(first, second, tolerance)
    return compare_nets(old[1:], new[1:]) if old[0] == NET else _compare_solvers(old[1:], new[1:])


def _read(path: str | Path) -> tuple[Any, ...]:
    """Return the kind of a file, and for a net or a solver also the message and its positions."""
    named = Path(path).suffix in (".caffemodel", ".h5")  # also if damaged; its reader reports the damage
    if Path(path).is_file() and (named or is_net_binary(path) or head_of(path).startswith(HDF5)):
        return (WEIGHTS,)
    try:
        return (NET, *parse_net(path))
    except SpecError as as_net:
        try:
            return (SOLVER, *parse_solver(path))
        except SpecError as as_solver:
            raise max(as_net, as_solver, key=lambda fault: fault.where.line if fault.where else 0) from None


def _compare_solvers(first: tuple[Any, Position], second: tuple[Any, Position]) -> Differences:
    """Yield the differences between the settings and between the nets. Paths of readable nets are not compared."""
    (one, there), (other, here) = first, second
    yield from differences(one, other, here, there, _NETS)
    faults: list[SpecError] = []
    old, new = (solver_nets(solver, node, faults.append) for solver, node in (first, second))
    if faults:
        for name in _NETS:
            was, now = getattr(one, name), getattr(other, name)
            if was != now:
                yield Difference(here.find(name), f"{name} differs; not compared: {faults[0]}", there.find(name))
        return
    if len(old) != len(new):
        yield Difference(here.find("test_iter"), f"{len(new)} nets, were {len(old)}", there.find("test_iter"))
    seen: set[str] = set()
    for was, now in zip(old, new, strict=False):
        for each in _in_net(was, now):
            if str(each) not in seen:
                seen.add(str(each))
                yield replace(each, message=f"{now.label}: {each.message}")


def _in_net(was: SolverNet, now: SolverNet) -> Differences:
    yield from compare_in_state((was.net, was.source), (now.net, now.source))
