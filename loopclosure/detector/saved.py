"""The file of a detector, and whether the net that described its frames is the one that describes the next."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.errors import InputError
from netspec.errors import SpecError

FORMAT = 1  # of the file that save writes
SAVED = "a file that LoopDetector.save wrote"

Describe = Callable[[np.ndarray], np.ndarray]


@contextmanager
def reading(path: str | Path, expected: str = SAVED) -> Iterator[None]:
    """Report whatever does not fit while a file is read as an InputError that contains ``expected``."""
    try:
        yield
    except SpecError as fault:
        raise fault if fault.where else InputError(fault.message, path) from None
    except (LookupError, OSError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"cannot be read ({reason}); expected {expected}", path) from None


def fingerprint_of(describe: Describe | None) -> str:
    """Return the ``fingerprint`` of a ``describe`` function; "" if it has none. Nets have one."""
    return str(getattr(describe, "fingerprint", ""))


def refuse_another(describes: str, described: str | None, instead: str, path: str | Path) -> None:
    """Raise InputError for fingerprints that differ; ``instead`` is the alternative to using the other net."""
    if describes and described and describes != described:
        fault = f"its frames were described by another net ({described}, this is {describes})"
        raise InputError(f"{fault}; use the version of the package that has it, {instead}", path)


def starts(found: Any, count: int) -> list[int]:
    """Check the first frame of each session of ``count`` frames. Raises ValueError or TypeError."""
    starts = [int(start) for start in found]
    if starts[:1] != [0] or sorted(starts) != starts or starts[-1] > count:
        raise ValueError(f"sessions that begin at {starts} of {count} frames")
    return starts
