"""Arrays of .npz files."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np

from netspec.errors import SpecError, Where

_FAULTS = (
    *(ValueError, LookupError, TypeError, AttributeError, ArithmeticError, SyntaxError, EOFError),
    *(NotImplementedError, RuntimeError, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)  # what numpy and zipfile raise for what is no .npz file


def read_npz(path: str | Path, expected: str) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file, by name. Raises SpecError, which says what was expected."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except OSError as fault:
        raise SpecError(f"cannot be read: {fault.strerror or fault}", Where(str(path))) from None
    except _FAULTS:
        raise SpecError(f"is not {expected}, or is damaged", Where(str(path))) from None
