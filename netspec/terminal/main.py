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

from netspec.terminal.process import end_forked_processes_by_sigterm, set_up


def program(module: str, words: Sequence[str] | None = None) -> int:
    """Run the command line of a module, and return its exit status.

    ``words`` are the arguments of the command line, None for those of this process. Then the process is expected to end
    with the command.

    SIGINT and SIGTERM print one line and exit with status 128 + the number of the signal. This holds from the start,
    since a short command spends most of its time importing. While Python shuts down, which takes 0.1 s or more, signals
    are ignored. Characters that the encoding of stdout lacks are printed as escapes, for example bytes of a file name
    that are not UTF-8. If stderr is closed, what is written to it is lost.
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
    """End the process with one line. It handles signals until a command runs: until then there is nothing to undo."""
    with suppress(OSError):
        os.write(2, b"interrupted\n")
    os._exit(128 + number)


def _ignore_signals(numbers: Sequence[int]) -> None:
    """Ignore the signals that ``end_at_once`` handles: while Python shuts down, it resets that handler."""
    for number in numbers:
        if signal.getsignal(number) is end_at_once:
            signal.signal(number, signal.SIG_IGN)


def _flush_stdout(status: int) -> int:
    """Flush stdout, and return the exit status. If this fails while Python shuts down, it prints a traceback."""
    out = sys.stdout
    if out is None:  # the caller has closed it
        return status
    try:
        out.flush()
    except OSError as fault:
        os.dup2(os.open(os.devnull, os.O_WRONLY), out.fileno())  # Python writes it again at exit
        if not isinstance(fault, BrokenPipeError):
            print(f"standard output: {fault.strerror}", file=sys.stderr)
        return status or 1
    return status
