"""The command ``loopclosure``. Each module has a group of commands, which parse arguments and call the library."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from loopclosure.cli import close, detect, evaluate, watch
from loopclosure.cli import map as maps
from netspec.terminal.commands import run
from netspec.terminal.parser import QUIET, Commands, Parser, program


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0: done, 1: an error in the user's files, 2: wrong usage, 128 + N: signal N."""
    return run(parser(), list(sys.argv[1:] if argv is None else argv))


def parser() -> Parser:
    """Return the parser of all commands."""
    made = program("loopclosure", "Evaluate, detect and close loops.")
    commands = Commands(made, **QUIET)
    for module in (evaluate, detect, watch, close, maps):
        module.add_commands(commands)
    return made
