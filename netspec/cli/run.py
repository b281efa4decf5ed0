"""What the commands of netspec share besides netspec.terminal: dialects, and effects of signals on a training."""

from __future__ import annotations

import argparse
import logging
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from netspec import log
from netspec.dialects import use_dialect
from netspec.files.limits import read_amount
from netspec.terminal import commands

READ, BUILT = 1, 2  # what a command does with nets: it reads their files, or makes them, which takes memory


class Commands(commands.Commands):
    """Commands that run with the dialects of ``--plugin``."""

    def add(
        self,
        name: str,
        function: Callable[[argparse.Namespace], int | None],
        summary: str,
        quiet: bool = False,
        net: int = 0,
    ) -> argparse.ArgumentParser:
        """Return the parser of a new command that runs ``function``, to add its own arguments to.

        A command of Caffe shows Caffe's log. A ``quiet`` command shows only warnings, and if it makes nets the log with
        ``-v``. ``net`` is READ, BUILT or 0.
        """
        added = super().add(name, function, summary)
        added.set_defaults(plugin=[], limit=None, begin=_use_dialects)
        if quiet:
            added.set_defaults(log_level=logging.WARNING, log_form=logging.Formatter("warning: %(message)s"))
        if quiet and net == BUILT:
            added.add_argument("-v", "--verbose", nargs=0, action=_Verbose, help="show Caffe's log")
        if net:
            plugin = "a dialect (the layers of a Caffe fork): its name, or a Python file of your own; may be repeated"
            added.add_argument("--plugin", action="append", default=[], metavar="NAME|FILE.py", help=plugin)
        if net == BUILT:
            added.add_argument(
                "--limit",
                type=_amount,
                metavar="SIZE",
                help="memory that a net may need, e.g. 64GiB; more is refused (default: this machine's)",
            )
        return added


def _use_dialects(arguments: argparse.Namespace) -> None:
    for plugin in arguments.plugin:
        use_dialect(plugin)


def _amount(text: str) -> int:
    try:
        return read_amount(text)
    except ValueError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


class _Verbose(argparse.Action):
    """Show the whole log, like the commands that Caffe has."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        namespace.log_level, namespace.log_form = logging.INFO, log.GlogFormatter()


class Signals:
    """What signals ask of a training: called between iterations, it returns the effect of one that came, or None.

    ``stopped_by`` is the number of the signal that asked to stop, 0 before. A second one that does ends the process at
    once.
    """

    def __init__(self) -> None:
        self.stopped_by = 0
        self._came: deque[str] = deque()

    def __call__(self) -> str | None:
        """Return the effect of the signal that came first, once."""
        return self._came.popleft() if self._came else None

    def receive(self, effect: str, number: int) -> None:
        """Note a signal that came."""
        if effect == "stop":
            if self.stopped_by:
                os._exit(128 + number)
            self.stopped_by = number
        self._came.append(effect)


@contextmanager
def signals(effects: Mapping[signal.Signals, str]) -> Iterator[Signals]:
    """Yield what receives the signals within the block, each with its effect: "stop", "snapshot" or "none"."""
    received = Signals()
    before = {}
    for number, effect in effects.items():
        handler = signal.SIG_IGN if effect == "none" else lambda n, _, effect=effect: received.receive(effect, n)
        before[number] = signal.signal(number, handler)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
