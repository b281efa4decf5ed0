"""Arguments that several commands share."""

from __future__ import annotations

import argparse


def size(text: str) -> tuple[int, int]:
    """Read ``WIDTHxHEIGHT``."""
    width, cross, height = text.partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f'expected WIDTHxHEIGHT such as 320x240, found "{text}"')
    return int(width), int(height)
