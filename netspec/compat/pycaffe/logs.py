"""Writes Caffe's log to stderr in glog's format, from the import of pycaffe on."""

from __future__ import annotations

import logging
import os
import sys
from typing import Any

from netspec import log
from netspec.terminal import output


class _Stderr(logging.StreamHandler):
    """Writes to the current stderr."""

    def __init__(self) -> None:
        logging.Handler.__init__(self)
        self.setFormatter(output.GlogFormatter())

    @property
    def stream(self) -> Any:
        return sys.stderr


_handler = _Stderr()


def start() -> None:
    """Show the log from the level in the environment variable GLOG_minloglevel on: 0 (INFO) to 3 (FATAL)."""
    if _handler not in log.logger.handlers:
        log.logger.addHandler(_handler)
        log.logger.propagate = False
    _set_level(os.environ.get(output.VARIABLE, "0"))


def stop() -> None:
    """Stop writing; the program's own handlers of the logger "netspec" still get the log."""
    log.logger.removeHandler(_handler)
    log.logger.propagate = True
    log.logger.setLevel(logging.NOTSET)


def init_log(level: int | None = None, stderr: bool = True) -> None:
    """Show the log from ``level`` on: 0 (INFO) to 3 (FATAL). It always goes to stderr; ``stderr`` has no effect."""
    if level is not None:
        _set_level(level)


def log_message(message: str) -> None:
    """Write a line to the log (``caffe.log``)."""
    log.info("_caffe.cpp:64", str(message))


def _set_level(level: int | str) -> None:
    try:
        number = int(level)
    except ValueError:
        number = 0
    chosen = output.SEVERITIES[min(max(number, 0), 3)]
    _handler.setLevel(chosen)
    log.logger.setLevel(chosen)
