"""Memory that passes freed, given back to the system."""

from __future__ import annotations

import ctypes
import sys
from functools import cache


def give_back_freed_memory() -> None:
    """Give back what lies free between blocks in use, where the C library can (glibc: malloc_trim).

    Passes on inputs of ever other sizes leave ever other holes; a run of six convolutions on 70 batch sizes kept five
    times the memory that it used.
    """
    if trim := _malloc_trim():
        trim(0)


@cache
def _malloc_trim():
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform.startswith("linux") else None
