"""Makes batches in threads, before the net needs them."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")
Make = Callable[[int, int], Sequence[T]]
Outcomes = list[tuple[T | None, BaseException | None]]  # of each iteration: its batch, or the exception of ``make``


class Feed(Generic[T]):
    """Returns the batches of iterations 0, 1, ... in order; ``workers`` threads make up to ``ahead`` in advance.

    ``make(first, count)`` returns the batches of ``count`` iterations. It must depend only on their numbers, so that
    batches depend neither on the number of threads nor on timing. Threads start at the first ``next()``; with ``ahead``
    0 there are none. ``next()`` raises the exception that ``make`` raised for its iteration. Threads make the batches
    of ``at_once`` iterations at a time, since waking a thread takes longer than making a small batch.
    """

    def __init__(self, make: Make[T], ahead: int, workers: int, at_once: int = 1) -> None:
        self._make = make
        self._ahead = ahead
        self._workers, self._at_once = workers, at_once
        self._pool: ThreadPoolExecutor | None = None
        self._pending: deque[tuple[int, Future[Outcomes[T]]]] = deque()  # with the first iteration of each
        self.position = 0  #: the iteration of the next batch
        self.waited = 0.0  #: total seconds in calls of ``next``

    def next(self) -> T:
        """Return the batch at ``position``, and advance."""
        start = time.perf_counter()
        try:
            return self._next()
        finally:
            self.waited += time.perf_counter() - start

    def _next(self) -> T:
        position = self.position
        made, fault = self._made_ahead(position) if self._ahead else _try_make(self._make, position, 1)[0]
        # Ctrl-C may interrupt any of these lines. It loses no batch, because this one alone counts them.
        self.position = position + 1
        if fault is not None:
            raise fault
        return made  # pyright: ignore[reportReturnType]

    def _made_ahead(self, position: int) -> tuple[T | None, BaseException | None]:
        """Return the batch of an iteration, or the exception, from the threads. Have the next ones made."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self._workers, thread_name_prefix="prefetch")
        while self._pending and self._pending[0][0] + self._at_once <= position:
            self._pending.popleft()
        end = self._pending[-1][0] + self._at_once if self._pending else position
        while end - position <= self._ahead:
            self._pending.append((end, self._pool.submit(_try_make, self._make, end, self._at_once)))
            end += self._at_once
        first, outcomes = self._pending[0]
        return outcomes.result()[position - first]

    def restart(self, position: int = 0) -> None:
        """Continue at iteration ``position``; discard batches made in advance."""
        pending, self._pending = self._pending, deque()  # at once: Ctrl-C must not leave a part of them
        self.position = position
        for _, outcomes in pending:
            outcomes.cancel()

    def close(self) -> None:
        """Stop the threads; a later ``next()`` starts them again."""
        self.restart(self.position)
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


def _try_make(make: Make[T], first: int, count: int) -> Outcomes[T]:
    """Return the batches of iterations, or their exceptions. If making all at once fails, make them one by one."""
    try:
        return [(batch, None) for batch in make(first, count)]
    except Exception as fault:
        if count == 1:
            return [(None, fault)]
    return [outcome for i in range(first, first + count) for outcome in _try_make(make, i, 1)]
