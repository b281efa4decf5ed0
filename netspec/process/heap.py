"""Memory that an iteration frees is kept for the next; gaps left by runs of changing sizes go back to the system.

The C library gives freed memory back to the system, which must clear it before the process gets it again: of a training
on a CPU that can take a twentieth of the time.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from typing import Any

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # malloc.h: M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
_LARGEST = 32 * 2**20  # bytes: the most that glibc takes from its heap, DEFAULT_MMAP_THRESHOLD_MAX
_USERS = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


@cache
def keep_freed_memory() -> None:
    """Tell glibc to keep what is freed, in blocks of up to 32 MB. What the user's environment says stays.

    It holds for the whole process. Other C libraries are left as they are.
    """
    if any(name in os.environ for name in _USERS) or not hasattr(os, "confstr"):
        return
    if "CS_GNU_LIBC_VERSION" not in os.confstr_names:
        return
    library = ctypes.CDLL(None)
    library.mallopt(_MMAP_THRESHOLD, _LARGEST)
    library.mallopt(_TRIM_THRESHOLD, 2**31 - 1)


def give_back_freed_memory() -> None:
    """Give the system what lies free between blocks in use, where the C library can (glibc: malloc_trim).

    Runs on inputs of changing sizes leave gaps of many sizes: a net of six convolutions that had seen 70 batch sizes
    held five times the memory that it used.
    """
    if trim := _malloc_trim():
        trim(0)


@cache
def _malloc_trim() -> Any:
    return getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform.startswith("linux") else None
