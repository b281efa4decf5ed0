"""Ctrl-C that waits for the end of an iteration, and signals in processes that are forked from our programs."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from types import FrameType


@cache
def end_forked_processes_by_sigterm() -> None:
    """Let SIGTERM end each process that is forked from now on, whatever handler of ours this process has.

    A forked process has the handlers of its parent, and ours wait for what only the parent does, such as the end of an
    iteration. Code that a net or a script brings along ends its workers by SIGTERM, and then waits for them.
    """
    if hasattr(os, "register_at_fork"):  # Windows has no fork
        os.register_at_fork(after_in_child=_end_by_sigterm)


def _end_by_sigterm() -> None:
    handler = signal.getsignal(signal.SIGTERM)
    if getattr(handler, "__module__", "").startswith("netspec."):
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def waiting_interrupts() -> Iterator[Callable[[], None]]:
    """Let Ctrl-C wait within the block until the function that is yielded is called, which raises KeyboardInterrupt.

    At the latest it is raised at the end of the block; a second Ctrl-C is raised at once. A handler that the program
    around it has set stays, and other threads than the main one are never interrupted.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: None
        return
    came: list[int] = []

    def wait(number: int, frame: FrameType | None) -> None:
        if came:
            signal.default_int_handler(number, frame)
        came.append(number)

    def interrupt() -> None:
        if came:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, wait)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    interrupt()
