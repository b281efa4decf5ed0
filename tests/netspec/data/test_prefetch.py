from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from netspec.data.prefetch import Feed
from netspec.net.net import Net
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


def interrupted(call: Callable[[], Any], line: int, *files: str) -> Any:
    """Return the result of a call, with KeyboardInterrupt raised before the given line that it runs in the files."""
    left = line

    def trace(frame: Any, event: str, _: Any) -> Any:
        nonlocal left
        if not frame.f_code.co_filename.endswith(files):
            return None
        if event == "line":
            left -= 1
            if left == 0:
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        return call()
    finally:
        sys.settrace(before)


@pytest.mark.parametrize(("ahead", "at_once"), [(0, 1), (2, 1), (8, 4)])
def test_a_batch_is_lost_only_after_it_was_counted(ahead: int, at_once: int) -> None:
    """Ctrl-C at each line of ``next``: the position and the batches agree, and threads still work."""
    feed = Feed(each(lambda i: i), ahead, 2, at_once)
    assert feed.next() == 0  # the threads run
    for line in range(1, 80):
        before = feed.position
        for _ in range(3):
            try:
                assert interrupted(feed.next, line, "data/prefetch.py") == feed.position - 1
            except KeyboardInterrupt:
                assert feed.position - before <= 3
        after = feed.position
        assert feed.next() == after
    feed.close()


@pytest.mark.parametrize("line", range(1, 40))
def test_an_interrupted_restart_leaves_no_batch_of_later_iterations(line: int) -> None:
    feed = Feed(lambda first, count: list(range(first, first + count)), ahead=3, workers=1)
    assert feed.next() == 0
    for first in (7, 2):
        with suppress(KeyboardInterrupt):
            interrupted(lambda first=first: feed.restart(first), line, "data/prefetch.py")
        feed.restart(first)
        with suppress(KeyboardInterrupt):
            interrupted(feed.next, line, "data/prefetch.py")
        after = feed.position
        assert [feed.next(), feed.next()] == [after, after + 1]
    feed.close()


def test_an_interrupted_pass_counts_no_records(net_of: Callable[..., Net]) -> None:
    """Also with an interrupt at each line, and again while the position is restored."""
    net = net_of(
        'layer { name: "m" type: "MemoryData" top: "d" top: "l" '
        "memory_data_param { batch_size: 1 channels: 1 height: 1 width: 1 } }"
    )
    net.set_input_arrays(np.zeros((1000, 1, 1, 1), np.float32), np.arange(1000, dtype=np.float32))
    expected = 0
    for line in range(1, 120):
        for again in (line, 3, line):
            try:
                label = int(interrupted(net, again, "net/net.py", "data/memory.py")["l"])
            except KeyboardInterrupt:
                continue
            assert label == expected
            expected += 1
        assert int(net()["l"]) == expected
        expected += 1
