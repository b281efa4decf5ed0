"""The command line: one module for each command; it parses arguments, shows progress and computes nothing."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from loopclosure.cli import close, compare, detect, evaluate, map, similarity
from netspec.terminal.commands import Commands, program, run

_COMMANDS = (evaluate, compare, detect, close, map, similarity)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0: done, 1: a fault of the user's files, 2: wrong usage, 128 + N: signal N."""
    return run(parser(), list(sys.argv[1:] if argv is None else argv))


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    made = program("loopclosure", "Evaluate, detect and close loops.")
    commands = Commands(made, quiet=True)
    for command in _COMMANDS:
        command.add_to(commands)
    return made
