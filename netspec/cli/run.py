"""What the commands of netspec share besides netspec.command_line: dialects, and effects of signals on a training."""

from __future__ import annotations

import argparse
import logging
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from netspec import command_line, log
from netspec.dialects import use_dialect
from netspec.limits import limited, read_amount


class Commands(command_line.Commands):
    """Commands that run with the dialects of ``--plugin``."""

    def add(
        self, name: str, function: Callable[[argparse.Namespace], int | None], summary: str, quiet: bool = False
    ) -> argparse.ArgumentParser:
        """Return the parser of a new command that runs ``function``, to add its own arguments to.

        A command of Caffe shows Caffe's log. A ``quiet`` command shows only warnings, and the log with ``-v``.
        """

        def with_dialects(arguments: argparse.Namespace) -> int | None:
            for plugin in arguments.plugin:
                use_dialect(plugin)
            with limited(arguments.limit):
                return function(arguments)

        added = super().add(name, with_dialects, summary)
        if quiet:
            added.set_defaults(log_level=logging.WARNING, log_form=logging.Formatter("warning: %(message)s"))
            added.add_argument("-v", "--verbose", nargs=0, action=_Verbose, help="show Caffe's log")
        plugin = "a dialect (the layers of a Caffe fork): its name, or a Python file of your own; may be repeated"
        added.add_argument("--plugin", action="append", default=[], metavar="NAME|FILE.py", help=plugin)
        added.add_argument(
            "--limit",
            type=_amount,
            metavar="SIZE",
            help="memory that a net may need, e.g. 64GiB; more is refused (default: this machine's)",
        )
        return added


def _amount(text: str) -> int:
    try:
        return read_amount(text)
    except ValueError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


class _Verbose(argparse.Action):
    """Show the whole log, like the commands that Caffe has."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        namespace.log_level, namespace.log_form = logging.INFO, log.GlogFormatter()


@contextmanager
def signals(effects: Mapping[signal.Signals, str]) -> Iterator[Callable[[], str | None]]:
    """Yield a function to call between iterations: it returns the effect of a received signal, or None.

    A second signal that stops ends the process at once.
    """
    came: list[str] = []
    stopping = False
    before = {}

    def receive(effect: str) -> None:
        nonlocal stopping
        if effect == "stop" and stopping:
            os._exit(command_line.INTERRUPTED)
        stopping |= effect == "stop"
        came.append(effect)

    for number, effect in effects.items():
        handler = signal.SIG_IGN if effect == "none" else lambda *_, effect=effect: receive(effect)
        before[number] = signal.signal(number, handler)
    try:
        yield lambda: came.pop(0) if came else None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
