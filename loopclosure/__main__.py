"""The program ``loopclosure``, and ``python -m loopclosure``."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from importlib import import_module


def program(module: str, words: Sequence[str] | None = None) -> int:
    """Run the command line of a module, and return its exit status.

    An interrupt is one line and status 130 from the start: most of a short command's time goes into imports.
    """
    usual = signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    try:
        if usual:
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        run = import_module(module).main
        if usual:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        return run(words)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def main() -> int:
    """Run one command of loopclosure."""
    return program("loopclosure.cli")


if __name__ == "__main__":
    sys.exit(main())
