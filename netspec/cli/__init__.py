"""The command line: one module for each command or family of commands; it computes nothing."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from netspec.cli import (
    bug_report,
    caffe_tools,
    check,
    completion,
    data,
    diff,
    draw,
    export,
    extract,
    fmt,
    lint,
    look,
    lsp,
    measure,
    plot,
    run_script,
    train,
    watch,
)
from netspec.cli.run import Commands
from netspec.terminal.commands import program, run

_FAMILIES = (
    *(train, measure, check, draw, diff, fmt, lint, lsp, extract, plot, watch, data, look, export),
    *(run_script, bug_report, caffe_tools),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0 when done, 1 for an error in the user's files, 2 for wrong usage."""
    words, script = list(sys.argv[1:] if argv is None else argv), []
    if words[:1] == [run_script.NAME]:
        words, script = run_script.split(words)
    made = parser()
    made.set_defaults(program=script)
    return run(made, words)


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    made = program("netspec", "Run Caffe's prototxt in PyTorch, with Caffe's numbers.")
    commands = Commands(made)
    for family in _FAMILIES:
        family.add_to(commands)
    completion.add_to(commands, parser)
    return made
