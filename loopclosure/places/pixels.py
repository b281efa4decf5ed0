"""Converts images of 16 bits to 8."""

from __future__ import annotations

import numpy as np

BITS = (8, 10, 12, 14, 16)  # of cameras


def bits_of(image: np.ndarray) -> int:
    """Return how many bits the values of an image use: cameras of 10, 12 or 14 bits write the low bits of 16."""
    brightest = int(image.max(initial=0))
    return next(bits for bits in BITS if brightest < 1 << bits)


def eight_bits(image: np.ndarray, least: int = 8) -> np.ndarray:
    """Convert pixels of 16 bits to 8 bits.

    least  how many bits other images of the same camera use: a dark image uses fewer, and must stay dark
    """
    if image.dtype != np.uint16:
        return image
    return (image >> (max(least, bits_of(image)) - 8)).astype(np.uint8)
