"""Safe reading of .npz and .npy files.

NumPy allocates the size that a header declares before it reads, and a small compressed file can decompress to any size.
Both are checked here against the size of the file. Python objects are refused, because unpickling can run any code.
"""

from __future__ import annotations

import io
import math
import os
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from netspec.errors import InputError
from netspec.files.kinds import nearest_existing
from netspec.files.limits import ALWAYS_ALLOWED, MOST_PACKED

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
    except _FAULTS as error:
        raise _fault(error, path, expected) from None


def read_npz(path: str | Path, expected: str) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name. Raises InputError, with ``expected``, for any other file."""
    with opened(Path(path), expected) as stream:
        if stream.seekable():
            return unpack(stream, os.fstat(stream.fileno()).st_size)
        data = stream.read()  # a pipe
        return unpack(io.BytesIO(data), len(data))


def unpack(packed: IO[bytes], stored: int) -> dict[str, np.ndarray]:
    """Return the arrays of an open .npz file of ``stored`` bytes. Raises the exceptions of zipfile and NumPy."""
    with zipfile.ZipFile(packed) as archive:
        entries = archive.infolist()
        size = sum(entry.file_size for entry in entries)
        if size > ALWAYS_ALLOWED and size > MOST_PACKED * stored:
            raise ValueError(f"its arrays would take {size / 2**20:.0f} MiB of memory, in a file of {stored} bytes")
        arrays: dict[str, np.ndarray] = {}
        for entry in entries:
            with archive.open(entry) as stream:
                arrays[entry.filename.removesuffix(".npy")] = read_array(stream, entry.file_size)
        return arrays


def read_header(stream: IO[bytes], size: int) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, whether the order is column-major, and dtype of an .npy array of ``size`` bytes in a stream."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, by_columns, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, by_columns, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise ValueError(f"an array of format {version}")
    if dtype.hasobject:
        raise ValueError("an array of Python objects (a pickle), which could run code; store lists in a .json file")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"an array of shape {shape}, {dtype}, in {size} bytes")
    return shape, by_columns, dtype


def read_array(stream: IO[bytes], size: int) -> np.ndarray:
    """Return the .npy array of ``size`` bytes in a stream."""
    shape, by_columns, dtype = read_header(stream, size)
    count = math.prod(shape)
    data = stream.read(count * dtype.itemsize)
    values = np.frombuffer(data, dtype, count).copy() if dtype.itemsize else np.zeros(count, dtype)
    if dtype.kind == "U" and np.any(values.view(np.dtype(np.uint32).newbyteorder(dtype.byteorder)) > sys.maxunicode):
        raise ValueError("an array with invalid Unicode characters")  # Python's strings would be broken
    return values.reshape(shape[::-1]).T if by_columns else values.reshape(shape)


def _fault(error: BaseException, path: Path, expected: str) -> InputError:
    if not path.exists():
        return InputError(f"no such file; expected {expected}{nearest_existing(path)}", path)
    if isinstance(error, InputError):
        return error
    reason = " ".join(str(error).split())
    if not reason or isinstance(error, LookupError):
        reason = f"{type(error).__name__} {reason}".rstrip()
    return InputError(f"cannot be read ({reason}); expected {expected}", path)
