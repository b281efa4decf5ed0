"""What every command shares: progress bars, and one line and an exit status for each way in which it can end."""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

from loopclosure.errors import InputError, printable
from loopclosure.progress import Item

DONE, FAULT, WRONG_USAGE = 0, 1, 2  # exit statuses; a signal's is 128 + its number: 130, 143


class WrongUsage(Exception):
    """Arguments that do not go together."""


class Commands:
    """The commands of a parser."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._parsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(self, name: str, function: Callable[[argparse.Namespace], None], summary: str) -> argparse.ArgumentParser:
        """Return the parser of a new command that runs ``function``, to add its own arguments to."""
        added = self._parsers.add_parser(name, help=summary, description=summary)
        added.set_defaults(run=function)
        return added


def run(parser: argparse.ArgumentParser, words: list[str]) -> int:
    """Parse a command line and run the command, which finds the line itself in ``command_line``; return its status."""
    try:
        arguments = parser.parse_args(words)
    except SystemExit as end:  # argparse has said what is wrong, or printed its help
        return int(end.code or DONE)
    arguments.command_line = shlex.join([parser.prog, *words])
    try:
        with interruptible():
            arguments.run(arguments)
        return DONE
    except InputError as fault:
        print(fault, file=sys.stderr)
        return FAULT
    except WrongUsage as fault:
        print(f"{parser.prog} {arguments.command}: error: {fault}", file=sys.stderr)
        return WRONG_USAGE
    except BrokenPipeError:
        return FAULT  # quietly
    except OSError as fault:
        print(f"{fault.filename}: {fault.strerror}" if fault.filename else fault, file=sys.stderr)
        return FAULT
    except MemoryError:
        print("there is not enough memory", file=sys.stderr)
        return FAULT
    except KeyboardInterrupt as end:
        print("interrupted", file=sys.stderr)
        return 128 + int(end.args[0] if end.args else signal.SIGINT)


@contextmanager
def interruptible() -> Iterator[None]:
    """Make SIGTERM interrupt the block as Ctrl-C does: a KeyboardInterrupt with the signal's number.

    A second of either ends the process at once. Signals that the program around it handles or ignores are left alone.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {number: handler for number, handler in before.items() if _is_usual(handler)}
    came: list[int] = []

    def interrupt(number: int, _: object) -> None:
        if came:
            os._exit(128 + number)
        came.append(number)
        raise KeyboardInterrupt(number)

    try:
        for number in before:
            signal.signal(number, interrupt)
        yield
    except Exception:
        if came:  # what is imported meanwhile may make another error of it
            raise KeyboardInterrupt(*came) from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_usual(handler: object) -> bool:
    """Say whether a signal has no handler but Python's own, or that of a program that starts (``end_at_once``)."""
    return handler in (signal.SIG_DFL, signal.default_int_handler) or getattr(handler, "__name__", "") == "end_at_once"


def warn(doubt: str) -> None:
    """Print a doubt about the user's files."""
    print(printable(f"warning: {doubt}"), file=sys.stderr)


def show_progress(items: Iterable[Item], stage: str, total: int | None = None) -> Iterable[Item]:
    """Show a bar on a terminal."""
    return tqdm(items, desc=stage, total=total, disable=None, leave=False, unit="")
