"""Reading .npz and .npy files by NumPy, without Python objects and without reading what no file of its size holds."""

from __future__ import annotations

import io
import os
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np

from netspec.errors import InputError
from netspec.files.kinds import nearest_existing
from netspec.files.limits import bomb

_FAULTS = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, SyntaxError),
    *(EOFError, NotImplementedError, RuntimeError, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
    *(struct.error, SystemError),
)


@contextmanager
def opened(path: Path, expected: str) -> Iterator[BinaryIO]:
    """Yield an open file. Errors within the block become an InputError that contains ``expected``."""
    try:
        with path.open("rb") as stream:
            yield stream
    except InputError:
        raise
    except _FAULTS as error:
        if not path.exists():
            raise InputError(f"no such file; expected {expected}{nearest_existing(path)}", path) from None
        reason = " ".join(str(error).split())
        if not reason or isinstance(error, LookupError):
            reason = f"{type(error).__name__} {reason}".rstrip()
        raise InputError(f"cannot be read ({reason}); expected {expected}", path) from None


def read_npz(path: str | Path, expected: str) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name. Raises InputError, with ``expected``, for any other file."""
    with opened(Path(path), expected) as stream:
        packed = stream if stream.seekable() else io.BytesIO(stream.read())  # a pipe
        stored = packed.seek(0, os.SEEK_END)
        with zipfile.ZipFile(packed) as archive:
            if fault := bomb(sum(entry.file_size for entry in archive.infolist()), stored):
                raise ValueError(fault)
            arrays: dict[str, np.ndarray] = {}
            for entry in archive.infolist():
                with archive.open(entry) as member:
                    arrays[entry.filename.removesuffix(".npy")] = read_array(member)
            return arrays


def read_array(stream: IO[bytes]) -> np.ndarray:
    """Return the .npy array in the rest of a stream. The end of a file in a zip archive is where its CRC is checked."""
    values = np.lib.format.read_array(stream, allow_pickle=False)
    if stream.read(1):
        raise ValueError(f"more bytes than an array of shape {values.shape}, {values.dtype}")
    if values.dtype.kind == "U" and values.size:
        points = np.ascontiguousarray(values).reshape(-1).view(np.dtype(np.uint32).newbyteorder(values.dtype.byteorder))
        if points.max(initial=0) > sys.maxunicode:
            raise ValueError("an array with invalid Unicode characters")  # Python's strings would be broken
    return values
