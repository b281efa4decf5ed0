"""Batches that threads make ahead of the net."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")


class Feed(Generic[T]):
    """Returns ``make(0)``, ``make(1)``, ... in order; ``workers`` threads make up to ``ahead`` of them in advance.

    ``make`` is a function of the iteration alone, so batches depend neither on the number of threads nor on timing. No
    thread runs before the first ``next()``; with ``ahead`` 0 none ever does. ``next()`` raises what ``make`` raises.
    """

    def __init__(self, make: Callable[[int], T], ahead: int, workers: int) -> None:
        self._make = make
        self._ahead = ahead
        self._workers = workers
        self._pool: ThreadPoolExecutor | None = None
        self._pending: deque[Future[T]] = deque()
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
            return self._make(position)
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self._workers, thread_name_prefix="prefetch")
        while len(self._pending) <= self._ahead:
            self._pending.append(self._pool.submit(self._make, position + len(self._pending)))
        return self._pending.popleft().result()

    def restart(self, position: int = 0) -> None:
        """Continue at iteration ``position``; batches made in advance are dropped."""
        while self._pending:
            self._pending.popleft().cancel()
        self.position = position

    def close(self) -> None:
        """Stop the threads; a later ``next()`` starts them again."""
        self.restart(self.position)
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
