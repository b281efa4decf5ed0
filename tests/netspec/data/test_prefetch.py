from __future__ import annotations

import concurrent.futures._base
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import pytest

from netspec.data.prefetch import Feed
from paths import ROOT


def each(make: Callable[[int], Any]) -> Callable[[int, int], list[Any]]:
    return lambda first, count: [make(i) for i in range(first, first + count)]


@each
def slow_square(i: int) -> int:
    time.sleep(0.002 * (i % 3))
    return i * i


@pytest.mark.parametrize(
    ("ahead", "workers", "at_once"), [(0, 1, 1), (1, 1, 1), (4, 3, 1), (4, 2, 3), (1, 2, 8), (0, 1, 8)]
)
def test_batches_are_in_order_for_any_number_of_threads(ahead: int, workers: int, at_once: int) -> None:
    feed = Feed(slow_square, ahead, workers, at_once)
    assert [feed.next() for _ in range(20)] == [i * i for i in range(20)]
    assert feed.position == 20
    feed.close()


@pytest.mark.parametrize("ahead", [0, 2])
def test_a_feed_measures_the_waiting_time(ahead: int) -> None:
    feed = Feed(each(lambda i: time.sleep(0.05)), ahead, workers=1)
    feed.next()
    assert feed.waited >= 0.05
    feed.close()


def test_batches_are_read_ahead_within_a_limit() -> None:
    made: list[int] = []
    feed = Feed(each(made.append), ahead=3, workers=1)
    feed.next()
    deadline = time.monotonic() + 60
    while len(made) < 4 and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.05)
    assert made == [0, 1, 2, 3]
    feed.close()


def test_no_thread_runs_before_the_first_batch_or_after_close() -> None:
    before = set(threading.enumerate())
    feed = Feed(slow_square, 2, 2)
    assert not set(threading.enumerate()) - before
    feed.next()
    assert set(threading.enumerate()) - before
    feed.close()
    assert not set(threading.enumerate()) - before
    assert feed.next() == 1  # it goes on where it was
    feed.close()


def test_an_unused_feed_ends_its_threads() -> None:
    before = set(threading.enumerate())
    feed = Feed(slow_square, 2, 2)
    feed.next()
    threads = set(threading.enumerate()) - before
    del feed
    for thread in threads:
        thread.join(timeout=60)
        assert not thread.is_alive()


@pytest.mark.parametrize("at_once", [1, 4])
def test_restart_can_go_to_any_iteration(at_once: int) -> None:
    feed = Feed(slow_square, 3, 2, at_once)
    feed.next()
    feed.restart()
    assert [feed.next(), feed.next()] == [0, 1]
    feed.restart(100)
    assert feed.next() == 10_000
    feed.close()


@pytest.mark.parametrize(("ahead", "at_once"), [(0, 1), (3, 1), (3, 4)])
def test_an_error_is_raised_at_its_batch(ahead: int, at_once: int) -> None:
    @each
    def make(i: int) -> int:
        if i == 2:
            raise ValueError(f"record {i}")
        return i

    feed = Feed(make, ahead, 2, at_once)
    assert [feed.next(), feed.next()] == [0, 1]
    with pytest.raises(ValueError, match="record 2"):
        feed.next()
    assert feed.next() == 3
    feed.close()


def test_the_interpreter_exits_with_an_open_feed() -> None:
    feed = "Feed(lambda i, n: [time.sleep(0.05)], 4, 4)"
    code = f"import time; from netspec.data.prefetch import Feed; {feed}.next(); print('end')"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "end\n", "")


@pytest.mark.parametrize(("ahead", "at_once"), [(0, 1), (2, 1), (8, 4)])
def test_an_interrupted_wait_loses_no_batch(ahead: int, at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while ``next`` waits for a thread: the next call returns the batch that was waited for."""
    interrupts = iter([False, True, False, True, True, False] + [False] * 20)

    class Interrupted(Future[Any]):
        def result(self, timeout: float | None = None) -> Any:
            if next(interrupts):
                raise KeyboardInterrupt
            return super().result(timeout)

    def make(first: int, count: int) -> list[int]:
        if not ahead and next(interrupts):
            raise KeyboardInterrupt
        return list(range(first, first + count))

    monkeypatch.setattr(concurrent.futures._base, "Future", Interrupted)
    feed = Feed(make, ahead, 2, at_once)
    found: list[int] = []
    stopped = 0
    while len(found) < 12:
        try:
            found.append(feed.next())
        except KeyboardInterrupt:
            stopped += 1
            assert feed.position == len(found)
    assert (found, stopped) == (list(range(12)), 3)
    feed.close()


def test_an_interrupted_restart_leaves_no_batch_of_later_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(future: Future[object]) -> bool:
        raise KeyboardInterrupt

    feed = Feed(lambda first, count: list(range(first, first + count)), ahead=3, workers=1)
    assert feed.next() == 0
    with monkeypatch.context() as patch:
        patch.setattr(Future, "cancel", interrupted)
        with pytest.raises(KeyboardInterrupt):
            feed.restart(7)
    assert [feed.next(), feed.next()] == [7, 8]
    feed.close()
