"""How much is too much: sizes that a file announces are believed within limits."""

from __future__ import annotations

import os

ALWAYS = 1 << 28  # bytes that any file may ask for
MOST_PACKED = 100  # times a file's size: real data is packed 2 to 20 times, a file made to fill the memory 1000 times


def memory() -> int:
    """Return the bytes of the machine's memory; a guess of 8 GiB where the system does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows
        return 8 << 30


def bomb(size: int, stored: int) -> str:
    """Return what to say of data of ``size`` bytes in a file of ``stored`` bytes that cannot be meant; "" if it can."""
    if size <= ALWAYS or (size <= MOST_PACKED * stored and size <= memory()):
        return ""
    return f"would take {amount(size)} of memory, in a file of {amount(stored)}; it is not read"


def amount(size: int) -> str:
    """Return a number of bytes for people: ``1.5 GiB``."""
    for power, unit in ((40, "TiB"), (30, "GiB"), (20, "MiB"), (10, "KiB")):
        if size >= 1 << power:
            return f"{size / (1 << power):.3g} {unit}"
    return f"{size} bytes"
