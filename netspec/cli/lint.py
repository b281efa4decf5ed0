"""``netspec lint``."""

from __future__ import annotations

import argparse
import json
import sys

from netspec.cli.arguments import add_python, add_shapes, add_state, options
from netspec.cli.run import READ, Commands
from netspec.terminal.commands import DONE, SOMETHING, UNREADABLE, WrongUsage, refuse


def add_to(commands: Commands) -> None:
    """Add the command."""
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


def _lint(arguments: argparse.Namespace) -> int:
    if arguments.rules == bool(arguments.files):
        raise WrongUsage("give files, or --rules")
    if arguments.rules:
        refuse(
            arguments, ("json", "level", "stage", "shape", "data", "allow_python_layers"), "is for files, not --rules"
        )
    from netspec.check.findings import RULES, said_as_json, said_once
    from netspec.check.lint import lint_file

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
