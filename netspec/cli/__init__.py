"""The command line: a module for each group of commands, with the table of its commands; it computes nothing."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from netspec.cli import caffe, data, export, nets, run_script, shell
from netspec.cli.arguments import Commands
from netspec.terminal.commands import program, run

# The modules of the commands, and the headings in ``netspec --help`` that these stand below.
_GROUPS = {
    "Caffe's programs": caffe,
    "look at nets": nets,
    "look at data and trainings": data,
    "use a net elsewhere": export,
    "old programs": run_script,
    "shell, help": shell,
}


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
    for commands.heading, module in _GROUPS.items():
        added = commands.read(module.TABLE, vars(module))
        if module is run_script:
            added[run_script.NAME].usage = run_script.USAGE
    return made
