"""Makes batches in threads, before the net needs them."""

from __future__ import annotations

import atexit
import time
from collections import deque
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from threading import Lock, Thread
from typing import Generic, NamedTuple, TypeVar
from weakref import WeakSet

T = TypeVar("T")
Make = Callable[[int, int], Sequence[T]]
Outcomes = list[tuple[T | None, BaseException | None]]  # of each iteration: its batch, or the exception of ``make``


class Feed(Generic[T]):
    """Returns the batches of iterations 0, 1, ... in order; ``workers`` threads make up to ``ahead`` in advance.

    ``make(first, count)`` returns the batches of ``count`` iterations. It must depend only on their numbers, so that
    batches depend neither on the number of threads nor on timing. Threads start at the first ``next()``; with ``ahead``
    0 there are none. ``next()`` raises the exception that ``make`` raised for its iteration. Threads make the batches
    of ``at_once`` iterations at a time, since waking a thread takes longer than making a small batch.

    Ctrl-C may interrupt any line of ``next()``: the next call then returns the same batch. The main thread therefore
    shares only a SimpleQueue and plain locks with the others. A Condition, and so a Future or an Executor, does not
    work any more when an interrupt leaves its lock held.
    """

    def __init__(self, make: Make[T], ahead: int, workers: int, at_once: int = 1) -> None:
        self._make = make
        self._ahead = ahead
        self._workers, self._at_once = workers, at_once
        self._crew: _Crew[T] | None = None
        self._pending: deque[_Block[T]] = deque()
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
        self.position = position + 1
        if fault is not None:
            raise fault
        return made  # pyright: ignore[reportReturnType]

    def _made_ahead(self, position: int) -> tuple[T | None, BaseException | None]:
        """Return the batch of an iteration, or the exception, from the threads. Have the next ones made."""
        if self._crew is None:
            self._crew = _started(self._make, self._workers)
            _open.add(self)
        if self._pending and not self._pending[0].first <= position < self._pending[-1].end:
            self._discard()
        while self._pending and self._pending[0].end <= position:
            self._pending.popleft()
        end = self._pending[-1].end if self._pending else position
        while end - position <= self._ahead:
            block = _Block[T](end, end + self._at_once)
            self._crew.requests.put(block)
            self._pending.append(block)
            end = block.end
        block = self._pending[0]
        return block.wait()[position - block.first]

    def restart(self, position: int = 0) -> None:
        """Continue at iteration ``position``. The next ``next()`` discards the batches made in advance for others."""
        self.position = position

    def _discard(self) -> None:
        while self._pending:
            self._pending.popleft().is_wanted = False

    def close(self) -> None:
        """Stop the threads; a later ``next()`` starts them again."""
        self._discard()
        if self._crew is not None:
            self._crew.stop()
            for thread in self._crew.threads:
                thread.join()
            self._crew = None

    def __del__(self) -> None:
        """Let the threads end. They are not waited for: this may run in one of them."""
        if self._crew is not None:
            self._crew.stop()


_open: WeakSet[Feed] = WeakSet()  # those with threads; Python must not end while they run code of other libraries


@atexit.register
def _close_all() -> None:
    for feed in list(_open):
        feed.close()


class _Block(Generic[T]):
    """The batches of the iterations from ``first`` up to ``end``, which a thread makes."""

    def __init__(self, first: int, end: int) -> None:
        self.first, self.end = first, end
        self.is_wanted = True
        self._outcomes: Outcomes[T] | None = None
        self._unfinished = Lock()
        self._unfinished.acquire()

    def run(self, make: Make[T]) -> None:
        """Make the batches, in a thread, unless nobody wants them any more."""
        if not self.is_wanted:
            return
        try:
            self._outcomes = _try_make(make, self.first, self.end - self.first)
        except BaseException as fault:
            self._outcomes = [(None, fault) for _ in range(self.first, self.end)]
        self._unfinished.release()

    def wait(self) -> Outcomes[T]:
        """Return the batches, or the exceptions, as soon as they are made."""
        while self._outcomes is None:
            self._unfinished.acquire()
        return self._outcomes


class _Crew(NamedTuple, Generic[T]):
    """Threads, and the queue of the blocks that they make. ``None`` in the queue ends one thread."""

    requests: SimpleQueue[_Block[T] | None]
    threads: list[Thread]

    def stop(self) -> None:
        """Have the threads end after the blocks that are still wanted."""
        for _ in self.threads:
            self.requests.put(None)


def _started(make: Make[T], workers: int) -> _Crew[T]:
    crew = _Crew[T](SimpleQueue(), [])
    for i in range(workers):
        thread = Thread(target=_work, args=(crew.requests, make), name=f"prefetch_{i}", daemon=True)
        thread.start()
        crew.threads.append(thread)
    return crew


def _work(requests: SimpleQueue[_Block[T] | None], make: Make[T]) -> None:
    while (block := requests.get()) is not None:
        block.run(make)
        del block  # a batch may be large


def _try_make(make: Make[T], first: int, count: int) -> Outcomes[T]:
    """Return the batches of iterations, or their exceptions. If making all at once fails, make them one by one."""
    try:
        return [(batch, None) for batch in make(first, count)]
    except Exception as fault:
        if count == 1:
            return [(None, fault)]
    return [outcome for i in range(first, first + count) for outcome in _try_make(make, i, 1)]
