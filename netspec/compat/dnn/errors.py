"""The error of this package. It is an error of both OpenCV and netspec, so ``except cv2.error`` works."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from netspec.errors import SpecError, Where
from netspec.files.opencv import cv2

# Codes of cv::Error (opencv2/core/base.hpp)
UNSPECIFIED, BAD_ARGUMENT, NOT_FOUND, NOT_IMPLEMENTED = -2, -5, -204, -213


class DnnError(cv2.error, SpecError):
    """A fault in a user's file, or wrong use of this module.

    It has the fields of cv2.error: ``code`` (a number of cv::Error), ``err`` and ``msg`` (the message), ``func``,
    ``file`` and ``line`` (of the user's file, if the fault is in one).
    """

    def __init__(self, message: str, where: Where | None = None, code: int = UNSPECIFIED, func: str = "") -> None:
        SpecError.__init__(self, message, where)
        self.code, self.func = code, func
        self.err, self.msg = message, str(self)
        self.file, self.line = (where.file, where.line) if where else ("", 0)


@contextmanager
def as_dnn_error(func: str) -> Iterator[None]:
    """Turn netspec's errors into :class:`DnnError`; ``func`` is the function that the user called."""
    try:
        yield
    except DnnError:
        raise
    except SpecError as fault:
        raise DnnError(fault.message, fault.where, func=func) from None
