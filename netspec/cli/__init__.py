"""The command ``netspec``. Each module has a group of commands, which parse arguments and call the library."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from netspec.cli import caffe, caffe_tools, data, export, nets, run_script
from netspec.terminal.commands import run
from netspec.terminal.parser import Commands, Parser, program

# The headings in ``netspec --help``, and the modules with the commands below each.
_GROUPS = {
    "Caffe's programs": [caffe, caffe_tools],
    "inspect nets": [nets],
    "inspect data and trainings": [data],
    "features and other formats": [export],
    "programs written for pycaffe": [run_script],
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
    for heading, modules in _GROUPS.items():
        commands.heading = heading
        for module in modules:
            module.add_commands(commands)
    return made
