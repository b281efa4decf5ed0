"""Arguments that several commands share."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path


def size(text: str) -> tuple[int, int]:
    """Read ``WIDTHxHEIGHT``."""
    width, cross, height = text.partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f'expected WIDTHxHEIGHT such as 320x240, found "{text}"')
    return int(width), int(height)


def next_command(*words: str | Path) -> str:
    """Return the next command of this program, as a user would type it."""
    return shlex.join(["lmdb-build", *map(str, words)])
