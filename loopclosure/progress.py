"""Progress and times of the stages of a computation; the caller decides how to show them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar

Item = TypeVar("Item")


class Progress(Protocol):
    """Wraps the items of one stage to show progress; ``stage`` is its name in the table of times."""

    def __call__(self, items: Iterable[Item], stage: str, total: int | None = None) -> Iterable[Item]:
        """Return an iterable of the same items."""
        ...


def silent(items: Iterable[Item], stage: str, total: int | None = None) -> Iterable[Item]:
    """Return ``items`` and show nothing."""
    return items


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the seconds that the block takes to ``seconds[stage]``."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
