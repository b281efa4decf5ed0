"""The command line: one module for each command or family of commands; it computes nothing."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from netspec.cli import (
    caffe_tools,
    check,
    data,
    export,
    extract,
    look,
    measure,
    nets,
    plot,
    run_script,
    shell,
    train,
    watch,
)
from netspec.cli.run import Commands
from netspec.terminal.commands import program, run

# The headings of ``netspec --help``, and the modules whose commands stand below each.
_GROUPS = {
    "Caffe's programs": (train, measure, caffe_tools),
    "look at nets": (check, nets, look),
    "look at data and trainings": (data, plot, watch),
    "use a net elsewhere": (extract, export),
    "old programs": (run_script,),
    "editor, shell, help": (shell,),
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
    for commands.heading, modules in _GROUPS.items():
        for module in modules:
            module.add_to(commands)
    return made
