"""``netspec check``, ``lint``, ``draw``, ``diff`` and ``layers``."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

from netspec.cli.arguments import (
    add_data,
    add_limit,
    add_passes,
    add_phase,
    add_plugin,
    add_python,
    add_shape,
    add_state,
    add_strict,
    add_verbose,
    options,
)
from netspec.errors import printable
from netspec.files.limits import no_collection
from netspec.proto.schema import PHASES, TEST, TRAIN
from netspec.terminal.commands import DONE, SOMETHING, UNREADABLE, WrongUsage, refuse
from netspec.terminal.parser import Commands


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_check(commands)
    _add_lint(commands)
    _add_draw(commands)
    _add_diff(commands)
    parser = commands.add_parser("layers", _layers, help="list the layer types, each with its description")
    add_plugin(parser)


def _add_check(commands: Commands) -> None:
    parser = commands.add_parser(
        "check", _check, help="build a net, or a solver's nets, and report all errors; no file is written"
    )
    add_verbose(parser)
    add_plugin(parser)
    add_limit(parser)
    parser.add_argument("file", metavar="FILE", help="a net's or a solver's prototxt")
    add_phase(parser)
    add_state(parser)
    add_shape(parser, text="shape of a data layer's top, instead of opening its data")
    add_data(parser)
    parser.add_argument(
        "--weights", metavar="WEIGHTS", help="check that these weights fit the net; several separated by commas"
    )
    parser.add_argument(
        "--plan",
        action="store_true",
        help="print the steps in which the net runs without gradients; this allocates its memory",
    )
    add_passes(parser)
    parser.add_argument(
        "--json",
        action="store_true",
        help="print blobs, params, inputs and outputs as JSON, or the errors if there are any",
    )
    add_strict(parser)
    add_python(parser)


@no_collection()  # of the whole command: of the text and the table too
def _check(arguments: argparse.Namespace) -> int:
    from netspec.inspect.check.check import as_json, check_file
    from netspec.inspect.check.findings import finding_lines, findings_as_json
    from netspec.inspect.check.plan import plan_text
    from netspec.net.table import table

    if not arguments.plan:
        refuse(arguments, ("passes",), "needs --plan, which prints their effect")
    elif arguments.json:
        refuse(arguments, ("plan",), "is not part of the JSON; leave out --json")
    how = {} if arguments.plan else {"device": "meta", "passes": ()}
    checked = check_file(
        arguments.file,
        PHASES[arguments.phase],
        options(arguments, given_shapes=dict(arguments.shape), **how),
        arguments.weights,
    )
    if len(checked) > 1:
        refuse(arguments, ("phase",), "is for a net; for a solver, the nets of both phases are checked")
    elif checked[0].net is not None and not arguments.weights:
        refuse(arguments, ("strict",), "needs --weights")
    advice = {str(found): found for part in checked for found in part.advice}
    for line in finding_lines(advice.values()):
        print(f"warning: {line}", file=sys.stderr)
    faults = {str(fault): fault for part in checked for fault in part.faults}
    if faults:
        print("\n".join(faults), file=sys.stderr)
        if arguments.json:
            print(json.dumps(findings_as_json(faults.values(), advice.values())))
        return 1
    nets = [(part.label, part.net) for part in checked if part.net is not None]
    if arguments.json:
        found = {label: as_json(net) for label, net in nets}
        print(json.dumps(next(iter(found.values())) if len(found) == 1 else found))
        return 0
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None  # a file gets all columns
    for label, net in nets:
        print(f"{label}: {printable(net.name) or 'a net without a name'}\n{table(net.plan, list(net.layers), width)}")
        print(f"memory: at least {net.need}\n")
        if arguments.plan:
            print(plan_text(net) + "\n")
    return 0


def _add_lint(commands: Commands) -> None:
    parser = commands.add_parser("lint", _lint, help="find probable mistakes in nets and solvers")
    add_plugin(parser)
    parser.add_argument("files", nargs="*", default=[], metavar="FILE", help="a net's or a solver's prototxt")
    parser.add_argument("--rules", action="store_true", help="print the rules and their reasons")
    parser.add_argument(
        "--json", action="store_true", help="print errors and findings as JSON, one object for each file"
    )
    add_state(parser)
    add_shape(parser, text="the shape of a data layer's top; some rules need shapes")
    add_data(parser)
    add_python(parser)


def _lint(arguments: argparse.Namespace) -> int:
    if arguments.rules == bool(arguments.files):
        raise WrongUsage("give files, or --rules")
    if arguments.rules:
        refuse(
            arguments, ("json", "level", "stage", "shape", "data", "allow_python_layers"), "is for files, not --rules"
        )
    from netspec.inspect.check.findings import RULES, finding_lines, findings_as_json
    from netspec.inspect.check.lint import lint_file

    for rule in sorted(RULES.values(), key=lambda rule: rule.name) if arguments.rules else ():
        print(f"{rule.name}: {rule.reason}")
    status = DONE
    for path in arguments.files:
        given = dict(arguments.shape)
        linted = lint_file(path, options(arguments, device="meta", given_shapes=given, passes=()))
        for fault in linted.unknown:
            print(f"warning: {fault}; rules that need shapes are not applied", file=sys.stderr)
        if arguments.json:
            print(json.dumps({"file": path, **findings_as_json(linted.faults, linted.found)}))
        for line in [*linted.faults, *finding_lines(linted.found)] if not arguments.json else ():
            print(line, file=sys.stdout if linted.readable else sys.stderr)
        found = SOMETHING if linted.faults or linted.found else DONE
        status = max(status, found if linted.readable else UNREADABLE)
    return status


FORMATS = (".svg", ".png", ".html")


def _add_draw(commands: Commands) -> None:
    parser = commands.add_parser("draw", _draw, help="draw a net: layers, shapes, shared parameters, multiply-adds")
    add_plugin(parser)
    parser.add_argument("file", metavar="FILE", help="a net, or a solver (its training net is drawn)")
    parser.add_output("--out", type=Path, required=True, metavar="F.svg|F.png|F.html", help="the file to write")
    add_phase(parser, default=None, text="only this phase (default: both in one)")
    add_state(parser)
    add_shape(parser, text="the shape of a data layer's top, if it is not known from the prototxt")
    add_data(parser, text="open databases and lists to learn their shapes")
    parser.add_argument(
        "--unfold", action="store_true", help="draw every copy of a repeated block (an HTML page has both forms)"
    )
    add_python(parser)


def _draw(arguments: argparse.Namespace) -> None:
    if arguments.out.suffix not in FORMATS:
        raise WrongUsage(f"--out {arguments.out}: expected a name that ends in {', '.join(FORMATS)}")
    if arguments.out.suffix == ".html":
        refuse(arguments, ("unfold",), "is for .svg and .png; an HTML page has both forms")
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


def _add_diff(commands: Commands) -> None:
    parser = commands.add_parser(
        "diff", _diff, help="print how two nets, solvers or weights differ, ignoring their formatting"
    )
    parser.set_defaults(fault_status=UNREADABLE)
    add_plugin(parser)
    parser.add_argument("first", metavar="A", help="a prototxt, a .caffemodel or a .caffemodel.h5")
    parser.add_argument("second", metavar="B", help="another of the same kind")
    parser.add_argument(
        "--tolerance",
        type=_tolerance,
        default=0.0,
        metavar="X",
        help="weights that differ by at most this much are equal (default: %(default)g)",
    )


def _diff(arguments: argparse.Namespace) -> int:
    from netspec.inspect.check.diff import compare_files

    status = DONE
    for each in compare_files(arguments.first, arguments.second, arguments.tolerance):
        print(each)
        status = SOMETHING
    return status


def _layers(arguments: argparse.Namespace) -> None:
    """Print each layer type with the first line of the docstring of its class."""
    from netspec.layers import layer_class, layer_types

    for name in layer_types():
        cls = layer_class(name)
        print(f"{name:28} {((cls and cls.__doc__) or '').strip().splitlines()[0]}")
