"""``netspec draw``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from netspec.cli.arguments import add_python, add_shapes, add_state, options
from netspec.cli.run import READ, Commands
from netspec.errors import printable
from netspec.proto.schema import PHASES, TEST, TRAIN
from netspec.terminal.commands import WrongUsage, refuse

FORMATS = (".svg", ".png", ".html")


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add(
        "draw", _draw, "draw a net: layers, shapes, shared parameters, multiply-adds", quiet=True, net=READ
    )
    p.add_argument("file", metavar="FILE", help="a net, a .caffemodel, or a solver, whose training net is drawn")
    p.add_argument("--out", required=True, type=Path, metavar="F.svg|F.png|F.html", help="the file to write")
    p.add_argument("--phase", choices=tuple(PHASES), type=str.upper, help="only this phase (default: both in one)")
    add_state(p, phase=None)
    add_shapes(p, "the shape of a data layer's top; without it shapes may be unknown")
    p.add_argument("--data", action="store_true", help="open databases and lists to learn their shapes")
    p.add_argument("--unfold", action="store_true", help="draw every copy of what repeats (HTML has both)")
    add_python(p)


def _draw(arguments: argparse.Namespace) -> None:
    if arguments.out.suffix not in FORMATS:
        raise WrongUsage(f"--out {arguments.out}: expected a name that ends in {', '.join(FORMATS)}")
    if arguments.out.suffix == ".html":
        refuse(arguments, ("unfold",), "is for .svg and .png; a page shows both")
    from netspec.draw.files import write_picture

    drawn = write_picture(
        arguments.file,
        arguments.out,
        phases=[PHASES[arguments.phase]] if arguments.phase else [TRAIN, TEST],
        options=options(arguments, given_shapes=dict(arguments.shape)),
        unfolded=arguments.unfold,
    )
    for fault in drawn.faults:
        print(f"warning: {fault}; shapes are missing from there on", file=sys.stderr)
    layers = sum(1 + len(box.attached) for box in drawn.boxes)
    print(f"{arguments.out}: {layers} layers of {printable(drawn.name) or 'a net without a name'}")
