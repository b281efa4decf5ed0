"""What every command shares: gflags' spellings, Caffe's log on stderr, faults as one line, signals."""

from __future__ import annotations

import argparse
import logging
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from netspec import log
from netspec.dialects import use_dialect
from netspec.errors import SpecError


class WrongUsage(Exception):
    """Arguments that do not go together."""


class Commands:
    """The commands of a parser, each with what all of them have."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._parsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(
        self, name: str, function: Callable[[argparse.Namespace], int | None], summary: str
    ) -> argparse.ArgumentParser:
        """Return the parser of a new command that runs ``function``, to add its own arguments to."""
        added = self._parsers.add_parser(name, help=summary, description=summary, allow_abbrev=False)
        added.set_defaults(run=function, log_level=logging.INFO, log_form=log.GlogFormatter())
        plugin = "a dialect: a fork's layers, by the name they come under or by a file of one's own; may be repeated"
        added.add_argument("--plugin", action="append", default=[], metavar="NAME|FILE.py", help=plugin)
        return added


def run(parser: argparse.ArgumentParser, words: list[str]) -> int:
    """Parse a command line, run the command's ``run``, and turn a fault of the user's files into one line."""
    try:
        arguments = parser.parse_args([_gflag(word) for word in words])
    except SystemExit as end:  # argparse has said what is wrong, or printed its help
        return int(end.code or 0)
    try:
        with _logging(arguments.log_level, arguments.log_form):
            for name in arguments.plugin:
                use_dialect(name)
            return arguments.run(arguments) or 0
    except SpecError as fault:
        print(fault, file=sys.stderr)
        return 1
    except WrongUsage as fault:
        print(f"{parser.prog} {arguments.command}: error: {fault}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def _gflag(word: str) -> str:
    """Return ``-flag`` as ``--flag``; argparse knows one-letter options only with one dash."""
    return "-" + word if re.match(r"-[A-Za-z_]\w", word) else word


@contextmanager
def _logging(level: int, form: logging.Formatter) -> Iterator[None]:
    """Show Caffe's log on stderr, around the progress bar where there is one.

    A warning is shown once, though a solver's nets may each have it.
    """
    handler = logging.StreamHandler(_BarAware())
    handler.setFormatter(form)
    handler.addFilter(_WarnOnce())
    before = log.logger.level, log.logger.propagate
    log.logger.addHandler(handler)
    log.logger.setLevel(level)
    log.logger.propagate = False
    try:
        yield
    finally:
        log.logger.removeHandler(handler)
        level, log.logger.propagate = before
        log.logger.setLevel(level)


class _WarnOnce(logging.Filter):
    """Lets each warning pass the first time only."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        message = record.getMessage()
        if record.levelno != logging.WARNING:
            return True
        new = message not in self.seen
        self.seen.add(message)
        return new


class _BarAware:
    """A stream that writes to stderr above a tqdm bar, if one is shown."""

    def write(self, text: str) -> None:
        tqdm = sys.modules.get("tqdm")
        if tqdm is None or not sys.stderr.isatty():
            sys.stderr.write(text)
        elif text.rstrip("\n"):
            tqdm.tqdm.write(text.rstrip("\n"), file=sys.stderr)

    def flush(self) -> None:
        sys.stderr.flush()


@contextmanager
def signals(effects: Mapping[signal.Signals, str]) -> Iterator[Callable[[], str | None]]:
    """Give what a training is to be asked between iterations: the effect of a signal that came, or None."""
    came: list[str] = []
    before = {}
    for number, effect in effects.items():
        handler = signal.SIG_IGN if effect == "none" else lambda *_, effect=effect: came.append(effect)
        before[number] = signal.signal(number, handler)
    try:
        yield lambda: came.pop(0) if came else None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
