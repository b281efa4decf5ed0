"""``netspec bug-report``."""

from __future__ import annotations

import argparse

from netspec.cli.run import Commands
from netspec.files.whole_file import write_whole


def add_to(commands: Commands) -> None:
    """Add the command."""
    summary = "collect versions, and files' shapes without weights or images, for a report of a fault"
    p = commands.add("bug-report", _bug_report, summary, quiet=True)
    p.add_argument("files", nargs="*", metavar="FILE", help="prototxt, weights, database, log: what the fault is about")
    p.add_argument("--out", metavar="F.md", help="write the report here (default: print it)")


def _bug_report(arguments: argparse.Namespace) -> None:
    from netspec.check.bug_report import bug_report

    text = bug_report(arguments.files)
    if not arguments.out:
        print(text, end="")
        return
    write_whole(arguments.out, text)
    print(f"{arguments.out}: read it before you send it; a prototxt and a log are in it as they are")
