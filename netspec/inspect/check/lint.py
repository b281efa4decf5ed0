"""``netspec lint``: applies the rules to a file in all its phases."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from netspec.errors import SpecError, UnknownShape
from netspec.graph.options import BuildOptions
from netspec.inspect.check.check import ON_META, Checked, check_file
from netspec.inspect.check.findings import Finding
from netspec.net.net import Net
from netspec.proto.schema import TEST, TRAIN


@dataclass
class Linted:
    """The findings in a file.

    ``faults`` are errors that prevent a net from being built. ``unknown`` ask for shapes; rules that need them
    were not applied. A file that is not ``readable`` has only faults. ``nets`` are the nets that were built.
    """

    found: list[Finding] = field(default_factory=list)
    faults: list[SpecError] = field(default_factory=list)
    unknown: list[SpecError] = field(default_factory=list)
    readable: bool = True
    nets: list[Net] = field(default_factory=list)


def lint_file(path: str | Path, options: BuildOptions = ON_META) -> Linted:
    """Apply the rules to a net in both phases, or to a solver and its nets; arguments as for check_file.

    A phase without a data layer is skipped if the other phase has one.
    """
    parts = check_file(path, TRAIN, options)
    if len(parts) == 1 and parts[0].net is not None:
        phases = [parts[0], *check_file(path, TEST, options)]
        parts = [part for part in phases if not _lacks_data(part)] or phases
    faults = {str(fault): fault for part in parts for fault in part.faults}.values()
    return Linted(
        list({str(found): found for part in parts for found in part.advice}.values()),
        [fault for fault in faults if not isinstance(fault, UnknownShape)],
        [fault for fault in faults if isinstance(fault, UnknownShape)],
        any(part.net is not None for part in parts),
        [part.net for part in parts if part.net is not None],
    )


def _lacks_data(part: Checked) -> bool:
    """Return whether every layer of a phase reads the top of another layer."""
    nodes = part.net.plan.nodes if part.net else ()
    return bool(nodes) and all(node.bottoms for node in nodes)
