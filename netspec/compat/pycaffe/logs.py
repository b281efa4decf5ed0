"""Caffe's log on stderr, from the moment that pycaffe is imported, as glog writes it."""

from __future__ import annotations

import logging
import os
import sys
from typing import Any

from netspec import log
from netspec.terminal.commands import SEVERITIES, VARIABLE


class _Stderr(logging.StreamHandler):
    """Writes to what stderr is at the time."""

    def __init__(self) -> None:
        logging.Handler.__init__(self)
        self.setFormatter(log.GlogFormatter())

    @property
    def stream(self) -> Any:
        return sys.stderr


_handler = _Stderr()


def start() -> None:
    """Show the log from the level on that the environment's GLOG_minloglevel says: 0 (INFO) to 3 (FATAL)."""
    if _handler not in log.logger.handlers:
        log.logger.addHandler(_handler)
        log.logger.propagate = False
    _set_level(os.environ.get(VARIABLE, "0"))


def stop() -> None:
    """Leave the log to the program's own handlers of the logger "netspec"."""
    log.logger.removeHandler(_handler)
    log.logger.propagate = True
    log.logger.setLevel(logging.NOTSET)


def init_log(level: int | None = None, stderr: bool = True) -> None:
    """Show the log from ``level`` on: 0 (INFO) to 3 (FATAL); it goes to stderr, whatever ``stderr`` says."""
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
    chosen = SEVERITIES[min(max(number, 0), 3)]
    _handler.setLevel(chosen)
    log.logger.setLevel(chosen)
