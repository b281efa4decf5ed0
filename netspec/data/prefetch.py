"""Batches that threads make ahead of the net."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")
Make = Callable[[int, int], Sequence[T]]
Made = list[tuple[T | None, BaseException | None]]


class Feed(Generic[T]):
    """Returns what ``make`` makes of the iterations 0, 1, ... in order; ``workers`` threads make up to ``ahead`` ahead.

    ``make(first, count)`` makes that of ``count`` iterations, as a function of their numbers alone, so batches depend
    neither on the number of threads nor on timing. No thread runs before the first ``next()``; with ``ahead`` 0 none
    ever does. ``next()`` raises what ``make`` raises for its iteration. Threads make ``at_once`` iterations at a time:
    to wake a thread takes longer than to make a small batch.
    """

    def __init__(self, make: Make[T], ahead: int, workers: int, at_once: int = 1) -> None:
        self._make = make
        self._ahead = ahead
        self._workers, self._at_once = workers, at_once
        self._pool: ThreadPoolExecutor | None = None
        self._pending: deque[Future[Made[T]]] = deque()
        self._made: deque[tuple[T | None, BaseException | None]] = deque()
        self.position = 0  #: the iteration whose batch comes next
        self.waited = 0.0  #: how many seconds calls of ``next`` have taken

    def next(self) -> T:
        """Return the batch at ``position``, and go to the next."""
        start = time.perf_counter()
        try:
            return self._next()
        finally:
            self.waited += time.perf_counter() - start

    def _next(self) -> T:
        position = self.position
        self.position += 1
        if not self._ahead:
            return self._make(position, 1)[0]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self._workers, thread_name_prefix="prefetch")
        while (coming := len(self._made) + self._at_once * len(self._pending)) <= self._ahead:
            self._pending.append(self._pool.submit(_made, self._make, position + coming, self._at_once))
        if not self._made:
            self._made.extend(self._pending.popleft().result())
        made, fault = self._made.popleft()
        if fault is not None:
            raise fault
        return made  # pyright: ignore[reportReturnType]

    def restart(self, position: int = 0) -> None:
        """Continue at iteration ``position``; batches made in advance are dropped."""
        self._made.clear()
        while self._pending:
            self._pending.popleft().cancel()
        self.position = position

    def close(self) -> None:
        """Stop the threads; a later ``next()`` starts them again."""
        self.restart(self.position)
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


def _made(make: Make[T], first: int, count: int) -> Made[T]:
    """Return what is made of iterations, or the fault of each; one by one where not all can be made at once."""
    try:
        return [(made, None) for made in make(first, count)]
    except Exception as fault:
        if count == 1:
            return [(None, fault)]
    return [each for i in range(first, first + count) for each in _made(make, i, 1)]
