"""What the code of a Python layer raises while a net is built passes through as it is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from netspec.errors import SpecError


@contextmanager
def original_errors() -> Iterator[None]:
    """Raise the exception that a Python layer's code has raised, in place of the fault that netspec makes of it."""
    try:
        yield
    except SpecError as fault:
        if isinstance(fault.__cause__, Exception):
            raise fault.__cause__ from fault
        raise
