"""The functions to read text files into upgraded messages, with the places of their parts, and to write text."""

from __future__ import annotations

from pathlib import Path

from netspec.errors import SpecError, Where
from netspec.proto.reader import read_text
from netspec.proto.schema import NetParameter, SolverParameter
from netspec.proto.source_map import Place, SourceMap
from netspec.proto.upgrade import current as upgrades
from netspec.proto.writer import write_text

__all__ = [
    "parse_net",
    "parse_net_text",
    "parse_solver",
    "parse_solver_text",
    "read_net",
    "read_solver",
    "write_text",
]


def read_net(path: str | Path) -> NetParameter:
    """Return the net of a .prototxt, upgraded to the current format. Raises SpecError."""
    return parse_net(path)[0]


def read_solver(path: str | Path) -> SolverParameter:
    """Return the solver of a .prototxt, upgraded to the current format. Raises SpecError."""
    return parse_solver(path)[0]


def parse_net(path: str | Path, upgrade: bool = True) -> tuple[NetParameter, SourceMap]:
    """Return the net of a .prototxt and the places of its parts. Raises SpecError."""
    return parse_net_text(_text_of(path), str(path), upgrade)


def parse_net_text(text: str, file: str, upgrade: bool = True) -> tuple[NetParameter, SourceMap]:
    """Return the net of a text and the places of its parts; ``file`` is its name in errors."""
    net = NetParameter()
    source = SourceMap.of(read_text(text, file, net))
    return upgrades.upgrade_net(net, source) if upgrade else (net, source)


def parse_solver(path: str | Path, upgrade: bool = True) -> tuple[SolverParameter, Place]:
    """Return the solver of a .prototxt and the places of its parts. Raises SpecError.

    The nets in it are upgraded too; ``SourceMap.of(node.fields["net_param"][0])`` is the map of one.
    """
    return parse_solver_text(_text_of(path), str(path), upgrade)


def parse_solver_text(text: str, file: str, upgrade: bool = True) -> tuple[SolverParameter, Place]:
    """Return the solver of a text and the places of its parts; ``file`` is its name in errors."""
    solver = SolverParameter()
    node = read_text(text, file, solver)
    if upgrade:
        solver, node = upgrades.upgrade_solver(solver, node)
        solver = upgrades.upgrade_snapshot_prefix(solver, file)
    return solver, node


def _text_of(path: str | Path) -> str:
    """Return a file's text without a byte-order mark; the lexer checks bytes that are not UTF-8."""
    try:
        data = Path(path).read_bytes()
    except OSError as fault:
        raise SpecError(f"cannot be read: {fault.strerror or fault}", Where(str(path))) from None
    return data.removeprefix(b"\xef\xbb\xbf").decode(errors="surrogateescape")
