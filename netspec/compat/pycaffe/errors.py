"""Errors for programs written for pycaffe."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from netspec.errors import SpecError


@contextmanager
def unwrapped_errors() -> Iterator[None]:
    """A block that raises an exception of the code of a Python layer unchanged, and not as a SpecError."""
    try:
        yield
    except SpecError as fault:
        if isinstance(fault.__cause__, Exception):
            raise fault.__cause__ from fault
        raise


def load(module: str, purpose: str) -> Any:
    """Import a module of scikit-image. Raises ImportError with one line that says what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as fault:
        message = f"{purpose} needs scikit-image: pip install scikit-image, or pip install 'netspec-caffe[pycaffe]'"
        raise ImportError(message) from fault
