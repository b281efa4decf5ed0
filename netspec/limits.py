"""How much is too much: sizes that a file announces are believed within limits."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ALWAYS = 1 << 28  # bytes that any file may ask for
MOST_PACKED = 100  # times a file's size: real data is packed 2 to 20 times, a file made to fill the memory 1000 times

_UNITS = {"": 0, "k": 10, "m": 20, "g": 30, "t": 40}
_CONTAINER = Path("/sys/fs/cgroup/memory.max")  # Linux: what a container may use, a number or "max"
_limit: int | None = None  # of this process, for all of its threads


def memory() -> int:
    """Return the bytes of the machine's memory; a guess of 8 GiB where the system does not tell.

    In a container it is what the container may use.
    """
    try:
        machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows
        return 8 << 30
    try:
        return min(machine, int(_CONTAINER.read_text()))
    except (ValueError, OSError):  # no limit, or no container
        return machine


def most() -> int:
    """Return the bytes of memory that a net may need: the machine's, unless :func:`limited` sets another limit."""
    return memory() if _limit is None else _limit


@contextmanager
def limited(size: int | None) -> Iterator[None]:
    """Set what a net may need within the block, in bytes, for the whole process; None changes nothing."""
    global _limit
    before = _limit
    _limit = before if size is None else size
    try:
        yield
    finally:
        _limit = before


def is_out_of_memory(fault: BaseException) -> bool:
    """Say whether an exception means that there was no memory: torch raises a RuntimeError."""
    return isinstance(fault, MemoryError) or (isinstance(fault, RuntimeError) and "allocate" in str(fault))


def bomb(size: int, stored: int) -> str:
    """Return what to say of data of ``size`` bytes in a file of ``stored`` bytes that cannot be meant; "" if it can."""
    if size <= ALWAYS or (size <= MOST_PACKED * stored and size <= memory()):
        return ""
    return f"would take {amount(size)} of memory, in a file of {amount(stored)}; it is not read"


def read_amount(text: str) -> int:
    """Return the bytes of ``16GiB``, ``16G``, ``1.5 T`` or ``1000000``. Raises ValueError for anything else."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?([kmgt]?)(?:i?b)?", text.strip(), re.IGNORECASE)
    if not match:
        raise ValueError(f"found {text!r}, expected a size, e.g. 16GiB")
    return int(float(match[1]) * (1 << _UNITS[match[2].lower()]))


def amount(size: int) -> str:
    """Return a number of bytes for people: ``1.5 GiB``."""
    for power, unit in ((40, "TiB"), (30, "GiB"), (20, "MiB"), (10, "KiB")):
        if size >= 1 << power:
            return f"{size / (1 << power):.3g} {unit}"
    return f"{size} bytes"
