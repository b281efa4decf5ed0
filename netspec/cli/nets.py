"""``netspec draw``, ``diff``, ``fmt`` and ``layers``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from netspec.cli.arguments import add_python, add_shapes, add_state, options
from netspec.cli.run import READ, Commands
from netspec.errors import SpecError, printable
from netspec.files.whole_file import write_whole
from netspec.proto.schema import PHASES, TEST, TRAIN
from netspec.terminal.commands import DONE, FAULT, SOMETHING, UNREADABLE, WrongUsage, refuse

FORMATS = (".svg", ".png", ".html")
STDIN = "-"


def add_to(commands: Commands) -> None:
    """Add the commands."""
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

    p = commands.add("diff", _diff, "tell what differs in meaning: nets, solvers or weights", quiet=True, net=READ)
    p.add_argument("first", metavar="A", help="a prototxt, a .caffemodel or a .caffemodel.h5")
    p.add_argument("second", metavar="B", help="another of the same kind")
    p.add_argument(
        "--tolerance",
        type=_tolerance,
        default=0.0,
        metavar="X",
        help="weights no further apart are equal (default: 0)",
    )
    p.set_defaults(fault_status=UNREADABLE)

    p = commands.add("fmt", _fmt, "write prototxt files in one form; comments are kept", quiet=True)
    p.add_argument("files", nargs="+", metavar="FILE", help="a net's or a solver's prototxt; - is standard input")
    p.add_argument("--check", action="store_true", help="write nothing; name the files that would change")

    commands.add("layers", _layers, "list the layer types, each with its description", quiet=True, net=READ)


def _draw(arguments: argparse.Namespace) -> None:
    if arguments.out.suffix not in FORMATS:
        raise WrongUsage(f"--out {arguments.out}: expected a name that ends in {', '.join(FORMATS)}")
    if arguments.out.suffix == ".html":
        refuse(arguments, ("unfold",), "is for .svg and .png; a page shows both")
    from netspec.inspect.draw.files import write_picture

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


def _tolerance(text: str) -> float:
    value = float(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"found {text}, expected a number of at least 0")
    return value


def _diff(arguments: argparse.Namespace) -> int:
    from netspec.inspect.check.compare import compare_files

    status = DONE
    for each in compare_files(arguments.first, arguments.second, arguments.tolerance):
        print(each)
        status = SOMETHING
    return status


def _fmt(arguments: argparse.Namespace) -> int:
    from netspec.proto.format import format_text
    from netspec.proto.text import text_of

    status = DONE
    for path in arguments.files:
        try:
            text = sys.stdin.read() if path == STDIN else text_of(path)
            formatted = format_text(text, path)
        except SpecError as fault:  # the other files are formatted all the same
            print(fault, file=sys.stderr)
            status = UNREADABLE if arguments.check else max(status, FAULT)
            continue
        if arguments.check:
            status = max(status, _differs(path, text, formatted))
        elif path == STDIN:
            print(formatted, end="")
        elif formatted == text:
            print(f"{path}: was in this form already")
        else:
            _write(path, formatted)
    return status


def _differs(path: str, text: str, formatted: str) -> int:
    """Say where a file would change; return the status."""
    if text == formatted:
        return DONE
    lines = zip(text.split("\n"), formatted.split("\n"), strict=False)
    first = next((k for k, (a, b) in enumerate(lines, 1) if a != b), 1)
    print(f"{path}:{first}:1: netspec fmt would change this line, the first of them")
    return SOMETHING


def _write(path: str, text: str) -> None:
    write_whole(path, text, "surrogateescape")
    print(f"{path}: formatted")


def _layers(arguments: argparse.Namespace) -> None:
    from netspec.layers import layer_class, layer_types

    for name in layer_types():
        cls = layer_class(name)
        first = ((cls and cls.__doc__) or "").strip().splitlines()[0]
        print(f"{name:28} {first}")
