"""Caffe's log in glog's line format, so that tools for Caffe's logs can read ours.

A line is ``I1121 00:36:27.939015 12135 solver.cpp:239] message``: severity and date, time, process, and the place in
Caffe's source that prints this message. The place is part of the format (log parsers match on it), so each call
gives it.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from typing_extensions import override

from netspec.errors import printable

logger = logging.getLogger("netspec")
SEVERITIES = (logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL)  # glog's 0 to 3
INTERRUPTED = "interrupted"  # how a command ends after a signal; netspec/inspect/logs reads it
VARIABLE = "GLOG_minloglevel"  # the environment variable with the lowest severity to log


class _OneLine(logging.Filter):
    """Makes each message one line, except for the text that :func:`dump` writes after its first line."""

    @override
    def filter(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = printable(record.getMessage()) + getattr(record, "text", ""), ()
        record.__dict__.pop("text", None)
        return True


logger.addFilter(_OneLine())


def info(site: str, message: str) -> None:
    """Log one message of Caffe; ``site`` is the file and line in Caffe that prints it."""
    logger.info(message, extra={"site": site})


def dump(site: str, title: str, text: str) -> None:
    """Log a message of Caffe and, on the lines after it, a protobuf text, whose strings are escaped."""
    logger.info(title, extra={"site": site, "text": "\n" + text})


def warning(site: str, message: str) -> None:
    """Log a warning; see :func:`info`."""
    logger.warning(message, extra={"site": site})


def error(site: str, message: str) -> None:
    """Log at level ERROR, at which some of Caffe's tools report progress; see :func:`info`."""
    logger.error(message, extra={"site": site})


@contextmanager
def silent() -> Iterator[None]:
    """Log nothing within the block."""
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


@contextmanager
def held_back() -> Iterator[list[logging.LogRecord]]:
    """Log nothing within the block, and yield the list of what :func:`write` then logs."""
    records: list[logging.LogRecord] = []

    def hold(record: logging.LogRecord) -> bool:
        records.append(record)
        return False

    logger.filters.insert(0, hold)  # before _OneLine, which a record passes once
    try:
        yield records
    finally:
        logger.removeFilter(hold)


def write(records: Iterable[logging.LogRecord]) -> None:
    """Log records that were held back."""
    for record in records:
        logger.handle(record)


class GlogFormatter(logging.Formatter):
    """Format records as glog did when Caffe was written: four fields, separated by spaces, before the message."""

    @override
    def format(self, record: logging.LogRecord) -> str:
        moment = time.localtime(record.created)
        micros = int(record.created % 1 * 1e6)
        stamp = f"{time.strftime('%m%d %H:%M:%S', moment)}.{micros:06d}"
        site = getattr(record, "site", f"{record.filename}:{record.lineno}")
        return f"{record.levelname[0]}{stamp} {os.getpid():5d} {site}] {record.getMessage()}"


def number(value: float) -> str:
    """Print a number as a C++ stream does: ``%g``, six significant digits."""
    return f"{value:g}"
