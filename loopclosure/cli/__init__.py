"""The command line: one module for each group of commands; it parses arguments, shows progress and computes nothing."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from loopclosure.cli import close, detect, evaluate
from netspec.terminal.commands import Commands, program, run


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0: done, 1: a fault of the user's files, 2: wrong usage, 128 + N: signal N."""
    return run(parser(), list(sys.argv[1:] if argv is None else argv))


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    made = program("loopclosure", "Evaluate, detect and close loops.")
    commands = Commands(made, quiet=True)
    for group in (evaluate, detect, close):
        commands.table(group.COMMANDS)
    maps = commands.group("map", "keep a map of several drives on disk: build it, add to it, query it")
    Commands(maps, quiet=True).table(detect.MAP_COMMANDS)
    return made
