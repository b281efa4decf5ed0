"""``netspec check`` and ``netspec lint``."""

from __future__ import annotations

import argparse
import json
import shutil
import sys

from netspec.cli.arguments import add_passes, add_python, add_shapes, add_state, add_strict, options
from netspec.cli.run import BUILT, READ, Commands
from netspec.errors import printable
from netspec.process.garbage import no_collection
from netspec.proto.binary import is_net_binary
from netspec.proto.schema import PHASES
from netspec.terminal.commands import DONE, SOMETHING, UNREADABLE, WrongUsage, refuse


def add_to(commands: Commands) -> None:
    """Add the commands."""
    p = commands.add(
        "check",
        _check,
        "build a net, or a solver's nets, and report every error; nothing is written",
        quiet=True,
        net=BUILT,
    )
    p.add_argument("file", metavar="FILE", help="a net's or a solver's prototxt, or a .caffemodel")
    add_state(p, phase="TEST")
    add_shapes(p, "the shape of a data layer's top; its data is then not opened")
    p.add_argument("--data", action="store_true", help="open databases, lists and mean files too")
    p.add_argument("--weights", help="weights that must fit the net, several separated by commas")
    p.add_argument("--plan", action="store_true", help="print how the net runs without gradients; needs its memory")
    add_passes(p)
    p.add_argument(
        "--json",
        action="store_true",
        help="print blobs, params, inputs, outputs as JSON; or the faults, if any",
    )
    add_strict(p)
    add_python(p)

    p = commands.add(
        "lint", _lint, "find what is legal but likely a mistake, in nets and solvers", quiet=True, net=READ
    )
    p.add_argument("files", nargs="*", metavar="FILE", help="a net's or a solver's prototxt")
    p.add_argument("--rules", action="store_true", help="print the rules, with their reasons")
    p.add_argument("--json", action="store_true", help="print faults and findings as JSON, one object for each file")
    add_state(p, phase=None)
    add_shapes(p, "the shape of a data layer's top; some rules need shapes")
    p.add_argument("--data", action="store_true", help="open databases, lists and mean files")
    add_python(p)


@no_collection()  # of the whole command: of the text and the table too
def _check(arguments: argparse.Namespace) -> int:
    from netspec.inspect.check.check import as_json, check_file
    from netspec.inspect.check.findings import said_as_json, said_once
    from netspec.inspect.check.plan import plan_text
    from netspec.net.table import table

    if not arguments.plan:
        refuse(arguments, ("passes",), "needs --plan, which prints what they do")
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
        refuse(arguments, ("phase",), "is for a net; of a solver the nets of both phases are checked")
    elif is_net_binary(arguments.file):
        refuse(arguments, ("phase", "level", "stage", "weights", "strict"), f"is for a prototxt, not {arguments.file}")
    elif checked[0].net is not None and not arguments.weights:
        refuse(arguments, ("strict",), "needs --weights")
    advice = {str(found): found for part in checked for found in part.advice}
    for line in said_once(advice.values()):
        print(f"warning: {line}", file=sys.stderr)
    faults = {str(fault): fault for part in checked for fault in part.faults}
    if faults:
        print("\n".join(faults), file=sys.stderr)
        if arguments.json:
            print(json.dumps(said_as_json(faults.values(), advice.values())))
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


def _lint(arguments: argparse.Namespace) -> int:
    if arguments.rules == bool(arguments.files):
        raise WrongUsage("give files, or --rules")
    if arguments.rules:
        refuse(
            arguments, ("json", "level", "stage", "shape", "data", "allow_python_layers"), "is for files, not --rules"
        )
    from netspec.inspect.check.findings import RULES, said_as_json, said_once
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
            print(json.dumps({"file": path, **said_as_json(linted.faults, linted.found)}))
        for line in [*linted.faults, *said_once(linted.found)] if not arguments.json else ():
            print(line, file=sys.stdout if linted.readable else sys.stderr)
        found = SOMETHING if linted.faults or linted.found else DONE
        status = max(status, found if linted.readable else UNREADABLE)
    return status
