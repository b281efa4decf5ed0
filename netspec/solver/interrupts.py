"""Ctrl-C that waits for the end of an iteration."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def waiting_interrupts() -> Iterator[Callable[[], None]]:
    """Delay Ctrl-C within the block. The yielded function raises KeyboardInterrupt if Ctrl-C was pressed.

    So does the end of the block. A second Ctrl-C raises it immediately. In threads other than the main one, and if the
    program has its own handler, nothing is delayed.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: None
        return
    received: list[int] = []

    def wait(number: int, frame: FrameType | None) -> None:
        if received:
            signal.default_int_handler(number, frame)
        received.append(number)

    def interrupt() -> None:
        if received:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, wait)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    interrupt()
