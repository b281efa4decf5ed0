"""The program ``loopclosure``, and ``python -m loopclosure``."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module


def program(module: str, words: Sequence[str] | None = None) -> int:
    """Run the command line of a module, and return its exit status.

    An interrupt is one line and status 130 from the start: most of a short command's time goes into imports. What the
    encoding of stdout does not have, such as bytes of a file name that are not UTF-8, is printed as escapes.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    usual = signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    try:
        if usual:
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        run = import_module(module).main
        if usual:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        return _written(run(words))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _written(status: int) -> int:
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


def main() -> int:
    """Run one command of loopclosure."""
    return program("loopclosure.cli")


if __name__ == "__main__":
    sys.exit(main())
