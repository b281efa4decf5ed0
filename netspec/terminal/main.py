"""How a program starts and ends; each package's ``__main__`` calls :func:`program`."""

from __future__ import annotations

import atexit
import io
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module

from netspec.process.programs import set_up
from netspec.process.signals import end_forked_processes_by_sigterm


def program(module: str, words: Sequence[str] | None = None) -> int:
    """Run the command line of a module, and return its exit status.

    An interrupt is one line and status 128 + its number from the start: most of a short command's time goes into
    imports. Without ``words`` those of the process are taken, and it ends with the command: it answers signals to
    Python's own end, which takes 0.1 s and longer, and lets them pass then. What the encoding of stdout does not have,
    such as bytes of a file name that are not UTF-8, is printed as escapes. Where stderr is closed, what goes there is
    lost.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    ours = [number for number, handler in before.items() if handler in (signal.SIG_DFL, signal.default_int_handler)]
    try:
        for number in ours:
            signal.signal(number, end_at_once)
        if words is None:
            atexit.register(_ignore_signals, ours)  # what is registered first comes last
        if sys.stderr is None:
            # No file gets descriptor 2 either, where libraries write.
            sys.stderr = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")
        set_up()
        end_forked_processes_by_sigterm()
        return _flush_stdout(import_module(module).main(words))
    finally:
        for number in ours if words is not None else ():
            signal.signal(number, before[number])


def end_at_once(number: int, _: object) -> None:
    """End the process with one line, while nothing is begun that must be undone; a command has a handler of its own."""
    with suppress(OSError):
        os.write(2, b"interrupted\n")
    os._exit(128 + number)


def _ignore_signals(numbers: Sequence[int]) -> None:
    """Pass signals over that would end the process at once: Python forgets that handler while it ends."""
    for number in numbers:
        if signal.getsignal(number) is end_at_once:
            signal.signal(number, signal.SIG_IGN)


def _flush_stdout(status: int) -> int:
    """Write what stdout still holds, and return the status. At its own end Python would print a traceback."""
    out = sys.stdout
    if out is None:  # the caller has closed it
        return status
    try:
        out.flush()
    except OSError as fault:
        os.dup2(os.open(os.devnull, os.O_WRONLY), out.fileno())  # it is written once more
        if not isinstance(fault, BrokenPipeError):
            print(f"standard output: {fault.strerror}", file=sys.stderr)
        return status or 1
    return status
