"""The command ``netspec``. Each module has a group of commands, which parse arguments and call the library."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from netspec.cli import caffe, caffe_tools, data, export, nets, run_script
from netspec.cli.arguments import use_dialects
from netspec.terminal.commands import run
from netspec.terminal.parser import CAFFES_LOG, NO_LOG, QUIET, Commands, Parser, program

# The headings in ``netspec --help``, and the log of the commands below each, and the modules with them.
_GROUPS = {
    "Caffe's programs": (CAFFES_LOG, caffe, caffe_tools),
    "inspect nets": (QUIET, nets),
    "inspect data and trainings": (QUIET, data),
    "features and other formats": (QUIET, export),
    "programs written for pycaffe": (NO_LOG, run_script),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0 when done, 1 for an error in the user's files, 2 for wrong usage."""
    words, script = list(sys.argv[1:] if argv is None else argv), []
    if words[:1] == [run_script.NAME]:
        words, script = run_script.split(words)
    made = parser()
    made.set_defaults(program=script)
    return run(made, words)


def parser() -> Parser:
    """Return the parser of all commands."""
    made = program("netspec", "Run Caffe's prototxt in PyTorch, with Caffe's numbers.")
    commands = Commands(made)
    for heading, (log, *modules) in _GROUPS.items():
        commands.heading, commands.defaults = heading, {**log, "prepare": use_dialects}
        for module in modules:
            module.add_commands(commands)
    return made
