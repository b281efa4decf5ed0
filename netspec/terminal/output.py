"""The output of a command: its log, progress bars, warnings about the user's files, and tables."""

from __future__ import annotations

import getpass
import logging
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from typing_extensions import override

from netspec import log
from netspec.errors import printable

SEVERITIES = (logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL)  # glog's 0 to 3
INTERRUPTED = "interrupted"  # how a command ends after a signal; netspec/inspect/logs reads it
VARIABLE = "GLOG_minloglevel"  # the environment variable with the lowest severity to log
OUT_OF_MEMORY = "out of memory; this machine has "  # how a command ends; netspec/inspect/logs reads it
Item = TypeVar("Item")


class GlogFormatter(logging.Formatter):
    """Format records as glog did when Caffe was written: four fields, separated by spaces, before the message."""

    @override
    def format(self, record: logging.LogRecord) -> str:
        moment = time.localtime(record.created)
        micros = int(record.created % 1 * 1e6)
        stamp = f"{time.strftime('%m%d %H:%M:%S', moment)}.{micros:06d}"
        site = getattr(record, "site", f"{record.filename}:{record.lineno}")
        return f"{record.levelname[0]}{stamp} {os.getpid():5d} {site}] {record.getMessage()}"


def bar(items: Iterable[Item], stage: str, total: int | None = None, unit: str = "") -> Iterable[Item]:
    """Return the items; on a terminal, a progress bar named ``stage`` shows how many the caller has taken."""
    from tqdm import tqdm  # commands that show no bar do not load it

    return tqdm(items, desc=stage, total=total, disable=None, leave=False, unit=unit)


def warn(message: str) -> None:
    """Print a warning about the user's files."""
    print(printable(f"warning: {message}"), file=sys.stderr)


def in_columns(rows: Sequence[Sequence[str]], left: int = 1, spans: Sequence[tuple[str, int]] = ()) -> list[str]:
    """Return rows of cells as lines. The first ``left`` columns are left-aligned, and the others right-aligned.

    ``spans`` are headings above the right-aligned columns: pairs of a text and the number of columns below it.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    if spans:
        over, at = " " * (sum(widths[:left]) + 2 * (left - 1)), left
        for name, columns in spans:
            over += f"  {f' {name} ':-^{sum(widths[at : at + columns]) + 2 * (columns - 1)}}"
            at += columns
        lines.append(over)
    for row in rows:
        cells = zip(row, widths, strict=True)
        lines.append("  ".join(c.ljust(w) if k < left else c.rjust(w) for k, (c, w) in enumerate(cells)))
    return lines


@contextmanager
def logging_to(
    level: int, form: logging.Formatter, folder: str | None, ending: Callable[[BaseException], str]
) -> Iterator[None]:
    """Show Caffe's log on stderr, above the progress bar if there is one; or write it into a folder, as glog does.

    A warning is shown once, even if several nets of a solver give it. If the block raises an exception, the file ends
    with the line that ``ending`` returns for it.
    """
    handlers: list[logging.Handler] = [logging.StreamHandler(_BarAware())]
    if folder:
        handlers[0].setLevel(logging.WARNING)
        moment = time.strftime("%Y%m%d-%H%M%S")
        name = f"caffe.{platform.node()}.{_user()}.log.INFO.{moment}.{os.getpid()}"
        handlers.append(logging.FileHandler(os.path.join(folder, name), encoding="utf-8"))
    for handler in handlers:
        handler.setFormatter(form)
        handler.addFilter(_WarnOnce())
    before = log.logger.level, log.logger.propagate
    for handler in handlers:
        log.logger.addHandler(handler)
    log.logger.setLevel(level)
    log.logger.propagate = False
    try:
        yield
    except BaseException as fault:
        for handler in handlers:
            if isinstance(handler, logging.FileHandler):
                with open(handler.baseFilename, "a", encoding="utf-8") as file:
                    file.write(f"{ending(fault)}\n")
        raise
    finally:
        for handler in handlers:
            log.logger.removeHandler(handler)
            handler.close()
        level, log.logger.propagate = before
        log.logger.setLevel(level)


def _user() -> str:
    """Return the user's name, or glog's "invalid-user" for one without, as in a container with ``--user 1234``."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return "invalid-user"


class _WarnOnce(logging.Filter):
    """Passes each warning only once."""

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
