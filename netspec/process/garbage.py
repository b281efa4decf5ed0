"""Python's garbage collector, paused where it costs more than it finds."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def no_collection() -> Iterator[None]:
    """Pause the collector within the block: it would visit all objects again and again while a large net grows.

    Afterwards, errors included, it is as it was; blocks may be nested. What is not in a cycle is freed at once as ever.
    """
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()
