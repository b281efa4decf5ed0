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


def seed(text: str) -> int:
    """Read a seed of random numbers, from 0."""
    value = int(text)
    if not 0 <= value < 2**31:
        raise argparse.ArgumentTypeError(f"found {text}, expected a number from 0 to {2**31 - 1}")
    return value


def above_zero(text: str) -> float:
    """Read a number above 0."""
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"found {text}, expected a number above 0")
    return value


def next_command(*words: str | Path) -> str:
    """Return the next command of this program, as a user would type it."""
    return shlex.join(["lmdb-build", *map(str, words)])
