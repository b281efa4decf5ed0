"""From a prototxt to a file with its picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from netspec.errors import SpecError
from netspec.files.whole_file import write_whole
from netspec.graph.options import BuildOptions
from netspec.inspect.draw.diagram import Diagram, diagram_of
from netspec.inspect.draw.picture import picture_of
from netspec.inspect.draw.svg import html_of, svg_of
from netspec.net.build import recover_net
from netspec.proto.binary import is_net_binary
from netspec.proto.schema import NetParameter, PhaseValue
from netspec.proto.source_map import SourceMap
from netspec.proto.text import parse_net, parse_solver
from netspec.solver.nets import solver_nets


def write_picture(
    path: str | Path, out: Path, phases: Sequence[PhaseValue], options: BuildOptions, unfolded: bool = False
) -> Diagram:
    """Draw the net of a file, or the training net of a solver, as SVG, PNG or HTML by the ending of ``out``.

    Of a .caffemodel the net inside it is drawn. Returns what was drawn; its faults keep parts of the net from being
    built: the picture has no shapes there. Raises SpecError for a file that cannot be read.
    """
    diagram = diagram_of(*_net_of(path, options), phases, options)
    picture = picture_of(diagram)
    if out.suffix == ".png":
        from netspec.inspect.draw.png import png_of

        content = png_of(picture, unfolded)
    elif out.suffix == ".html":
        content = html_of(diagram, picture).encode()
    else:
        content = svg_of(picture, unfolded).encode()
    write_whole(out, content)
    return diagram


def _net_of(path: str | Path, options: BuildOptions) -> tuple[NetParameter, SourceMap]:
    if is_net_binary(path):
        return recover_net(path, options.given_shapes)
    try:
        return parse_net(path)
    except SpecError:
        try:
            solver, node = parse_solver(path)
        except SpecError:
            solver = None
        if solver is None:
            raise
    described = solver_nets(solver, node)
    return described[0].net, described[0].source
