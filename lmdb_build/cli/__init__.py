"""The command ``lmdb-build``. Each module has a group of commands, which parse arguments and call the library."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from lmdb_build.cli import databases, images, pairs
from netspec.files.opencv import cv2
from netspec.terminal.commands import run
from netspec.terminal.parser import Commands, Parser, program


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0: done, 1: an error in the user's files, 2: wrong usage, 128 + N: signal N."""
    cv2.setNumThreads(1)  # the images are small
    return run(parser(), list(sys.argv[1:] if argv is None else argv))


def parser() -> Parser:
    """Return the parser of all commands."""
    made = program(
        "lmdb-build", "Choose labeled pairs of images, write databases that Caffe reads, and compare Siamese nets."
    )
    commands = Commands(made)
    for module in (images, pairs, databases):
        module.add_commands(commands)
    return made
