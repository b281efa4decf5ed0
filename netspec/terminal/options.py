"""Numbers that options of the commands take."""

from __future__ import annotations

import argparse


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
