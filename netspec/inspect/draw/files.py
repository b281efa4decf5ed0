"""Writes the drawing of a net to a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from netspec import log
from netspec.files.whole_file import write_whole
from netspec.graph.options import BuildOptions
from netspec.inspect.draw.diagram import Diagram, diagram_of
from netspec.inspect.draw.dot import dot_of
from netspec.inspect.draw.graphviz import render
from netspec.inspect.draw.page import net_page
from netspec.inspect.net_or_solver import parse_net_or_solver
from netspec.proto.schema import NetParameter, PhaseValue
from netspec.solver.nets import solver_nets

SLOW_TO_DRAW = 5000  # boxes; drawing them takes about half a minute


def write_picture(
    path: str | Path, out: Path, phases: Sequence[PhaseValue], options: BuildOptions, unfolded: bool = False
) -> Diagram:
    """Draw the net of a file, or the training net of a solver, as SVG, PNG or HTML by the ending of ``out``.

    Returns the diagram. Its faults are the errors in parts that could not be built and have no shapes. Raises
    SpecError for a file that cannot be read, or if Graphviz is missing.
    """
    read: Any = parse_net_or_solver(path)
    net, source = read
    if not isinstance(net, NetParameter):
        training = solver_nets(net, source)[0]
        net, source = training.net, training.source
    diagram = diagram_of(net, source, phases, options)
    if len(diagram.boxes) > SLOW_TO_DRAW:
        log.warning(
            "draw_net.py:1",
            f"drawing {len(diagram.boxes)} boxes takes minutes, since Graphviz's time grows with their square",
        )
    if out.suffix == ".html":
        content = net_page(diagram).encode()
    else:
        content = render(dot_of(diagram, unfolded), out.suffix[1:])
    write_whole(out, content)
    return diagram
