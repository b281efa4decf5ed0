"""Reads a prototxt that may be a net or a solver."""

from __future__ import annotations

from pathlib import Path

from netspec.errors import SpecError
from netspec.proto.schema import NetParameter, SolverParameter
from netspec.proto.source_map import Position, SourceMap
from netspec.proto.text import parse_net, parse_solver


def parse_net_or_solver(path: str | Path) -> tuple[NetParameter, SourceMap] | tuple[SolverParameter, Position]:
    """Return the message and its positions. Raises the SpecError of the reading that got further."""
    try:
        return parse_net(path)
    except SpecError as as_net:
        try:
            return parse_solver(path)
        except SpecError as as_solver:
            raise max(as_net, as_solver, key=lambda fault: fault.where.line if fault.where else 0) from None
