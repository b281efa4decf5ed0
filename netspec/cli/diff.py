"""``netspec diff``."""

from __future__ import annotations

import argparse

from netspec.cli.run import READ, Commands
from netspec.terminal.commands import DONE, SOMETHING, UNREADABLE


def add_to(commands: Commands) -> None:
    """Add the command."""
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


def _tolerance(text: str) -> float:
    value = float(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"found {text}, expected a number of at least 0")
    return value


def _diff(arguments: argparse.Namespace) -> int:
    from netspec.check.compare import compare_files

    status = DONE
    for each in compare_files(arguments.first, arguments.second, arguments.tolerance):
        print(each)
        status = SOMETHING
    return status
