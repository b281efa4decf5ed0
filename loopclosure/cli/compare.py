"""``loopclosure compare``."""

from __future__ import annotations

import argparse

from netspec.terminal.commands import Commands, WrongUsage


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("compare", _compare, "put the reports of several evaluations side by side: table and curves")
    p.add_argument("reports", nargs="+", metavar="REPORT.json", help="two or more, as evaluate writes them")
    p.add_argument("--out", default="comparison.html", metavar="FILE.html", help="the page (default: %(default)s)")


def _compare(a: argparse.Namespace) -> None:
    # Drawing takes seconds to import, which the other commands need not wait for.
    from loopclosure.report.compare import read_reports, text, write_comparison

    if len(a.reports) < 2:
        raise WrongUsage("one report was given; expected two or more")
    reports = read_reports(a.reports)
    write_comparison(reports, a.out, a.command_line)
    print(text(reports))
    print(f"comparison: {a.out}")
