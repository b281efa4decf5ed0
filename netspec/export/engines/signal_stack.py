"""The stack on which a thread handles signals, kept as it was."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_ENOUGH = 64  # bytes: a stack_t has 24


@contextmanager
def signal_stack_kept() -> Iterator[None]:
    """Give the thread its alternate signal stack back after the block, on Linux; elsewhere do nothing.

    Each ``openvino.Core`` sets one when it loads its CPU plugin, and frees it when it is deleted. If the thread still
    has that stack then, it gets the one from before, which may be that of a Core deleted earlier: freed memory, and the
    next signal that Python handles ends the process.
    """
    if not sys.platform.startswith("linux"):
        yield
        return
    library = ctypes.CDLL(None)
    before = ctypes.create_string_buffer(_ENOUGH)
    library.sigaltstack(None, before)
    try:
        yield
    finally:
        library.sigaltstack(before, None)
