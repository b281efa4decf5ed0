"""Caffe's log: glog's line form, so that the tools people have for Caffe's logs read ours.

A line is ``I1121 00:36:27.939015 12135 solver.cpp:239] message``: severity and date, time, process, the place in
Caffe's source that prints this sentence. The place is part of the format (log parsers match on it), so each call
names it.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

from typing_extensions import override

logger = logging.getLogger("netspec")


def info(site: str, message: str) -> None:
    """Log one sentence of Caffe's, ``site`` being the file and line in Caffe that prints it."""
    logger.info(message, extra={"site": site})


def warning(site: str, message: str) -> None:
    """Log a warning; see :func:`info`."""
    logger.warning(message, extra={"site": site})


def error(site: str, message: str) -> None:
    """Log at the level at which some of Caffe's tools tell their progress; see :func:`info`."""
    logger.error(message, extra={"site": site})


@contextmanager
def silent() -> Iterator[None]:
    """Log nothing for a while."""
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


class GlogFormatter(logging.Formatter):
    """Format records as the glog of Caffe's time did: exactly four blank-separated fields before the message."""

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
