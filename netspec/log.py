"""Caffe's log in glog's line format, so that tools for Caffe's logs can read ours.

A line is ``I1121 00:36:27.939015 12135 solver.cpp:239] message``: severity and date, time, process, and the place in
Caffe's source that prints this message. The place is part of the format (log parsers match on it), so each call
gives it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from typing_extensions import override

from netspec.errors import printable

logger = logging.getLogger("netspec")


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


def number(value: float) -> str:
    """Print a number as a C++ stream does: ``%g``, six significant digits."""
    return f"{value:g}"
