"""Reading text files into upgraded messages, with the positions of their parts, and writing text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from netspec.errors import SpecError, Where
from netspec.files.kinds import kind_of, pointer_fault, unreadable
from netspec.files.limits import read_bytes
from netspec.proto.binary import is_net_binary
from netspec.proto.reader import read_text
from netspec.proto.schema import NetParameter, SolverParameter
from netspec.proto.source_map import Position, SourceMap
from netspec.proto.upgrade import current as upgrades
from netspec.proto.writer import write_text

__all__ = ["parse_net", "parse_net_text", "parse_solver", "parse_solver_text", "read_net", "read_solver", "write_text"]


Report = Callable[[SpecError], None] | None


def read_net(path: str | Path) -> NetParameter:
    """Return the net of a .prototxt, upgraded to the current format. Raises SpecError."""
    return parse_net(path)[0]


def read_solver(path: str | Path) -> SolverParameter:
    """Return the solver of a .prototxt, upgraded to the current format. Raises SpecError."""
    return parse_solver(path)[0]


def parse_net(path: str | Path, upgrade: bool = True, report: Report = None) -> tuple[NetParameter, SourceMap]:
    """Return the net of a .prototxt, and the positions of its parts. Raises SpecError.

    ``report``, if given, gets a ForkFault for each unknown field, which is then left out.
    """
    return parse_net_text(text_of(path), str(path), upgrade, report)


def parse_net_text(text: str, file: str, upgrade: bool = True, report: Report = None) -> tuple[NetParameter, SourceMap]:
    """Return the net in a text, and the positions of its parts; ``file`` is its name in errors."""
    net = NetParameter()
    source = SourceMap.of(read_text(text, file, net, report))
    return upgrades.upgrade_net(net, source) if upgrade else (net, source)


def parse_solver(path: str | Path, upgrade: bool = True, report: Report = None) -> tuple[SolverParameter, Position]:
    """Return the solver of a .prototxt, and the positions of its parts. Raises SpecError.

    The nets in it are upgraded too; ``SourceMap.of(node.fields["net_param"][0])`` is the map of one. For ``report``
    see :func:`parse_net`.
    """
    return parse_solver_text(text_of(path), str(path), upgrade, report)


def parse_solver_text(
    text: str, file: str, upgrade: bool = True, report: Report = None
) -> tuple[SolverParameter, Position]:
    """Return the solver in a text, and the positions of its parts; ``file`` is its name in errors."""
    solver = SolverParameter()
    node = read_text(text, file, solver, report)
    if upgrade:
        solver, node = upgrades.upgrade_solver(solver, node)
        solver = upgrades.upgrade_snapshot_prefix(solver, file)
    return solver, node


def text_of(path: str | Path) -> str:
    """Return a file's text without a byte-order mark; the lexer checks bytes that are not UTF-8."""
    try:
        data = read_bytes(path)
    except OSError as fault:
        raise SpecError(unreadable(path, fault), Where(str(path))) from None
    binary = b"\0" in data and is_net_binary(path)
    kind = kind_of(data) or ("a .caffemodel; give the prototxt of its net" if binary else "")
    if fault := pointer_fault(data) or (kind and f"expected a prototxt, found {kind}"):
        raise SpecError(fault, Where(str(path)))
    return data.removeprefix(b"\xef\xbb\xbf").decode(errors="surrogateescape")
