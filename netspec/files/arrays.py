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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, BinaryIO, TypeVar, cast

import numpy as np

from netspec.errors import InputError
from netspec.files.kinds import nearest_existing
from netspec.files.limits import ALWAYS_ALLOWED, MOST_PACKED

T = TypeVar("T")
_FAULTS = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, SyntaxError),
    *(EOFError, NotImplementedError, RuntimeError, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
    *(struct.error, SystemError),
)


@contextmanager
def _opened(path: Path, expected: str) -> Iterator[BinaryIO]:
    """Yield an open file. Errors within the block become an InputError that contains ``expected``."""
    try:
        with path.open("rb") as stream:
            yield stream
    except _FAULTS as error:
        raise _fault(error, path, expected) from None


def read_npz(path: str | Path, expected: str) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name. Raises InputError, with ``expected``, for any other file."""
    with _opened(Path(path), expected) as stream:
        if stream.seekable():
            return unpack(stream, os.fstat(stream.fileno()).st_size)
        data = stream.read()  # a pipe
        return unpack(io.BytesIO(data), len(data))


def read_npy(path: str | Path, expected: str) -> np.ndarray:
    """Return the array of an .npy file. Raises InputError, with ``expected``, for any other file."""
    with _opened(Path(path), expected) as stream:
        return _read(stream, os.fstat(stream.fileno()).st_size)


class Rows:
    """The array (N, ...) of an .npy file. ``rows[first:end]`` reads only these rows.

    The file is not memory-mapped, because reading a mapped file that was truncated meanwhile ends the process. Raises
    InputError, with ``expected``, for any other file.
    """

    def __init__(self, path: str | Path, expected: str) -> None:
        self._path, self._expected = regular(path, expected), expected
        with _opened(self._path, expected) as stream:
            self.shape, by_columns, self.dtype = _header(stream, os.fstat(stream.fileno()).st_size)
            self._start = stream.tell()
            if by_columns or not self.shape:
                raise ValueError("an array that is not stored in row-major (C) order")
        self.size = math.prod(self.shape)

    def __getitem__(self, rows: slice) -> np.ndarray:
        first, end, _ = rows.indices(self.shape[0])
        shape = (max(0, end - first), *self.shape[1:])
        width = math.prod(self.shape[1:]) * self.dtype.itemsize
        with _opened(self._path, self._expected) as stream:
            stream.seek(self._start + first * width)
            data = stream.read(shape[0] * width)
            if len(data) < shape[0] * width:
                raise ValueError("it was truncated after it was opened")
        return np.frombuffer(data, self.dtype).reshape(shape) if data else np.zeros(shape, self.dtype)


def regular(path: str | Path, expected: str) -> Path:
    """Return the path of a file. Raises InputError for a pipe or device, because reading it might never end."""
    path = Path(path)
    if path.exists() and not path.is_file():
        raise InputError(f"is not a regular file; expected {expected}", path)
    return path


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
                arrays[entry.filename.removesuffix(".npy")] = _read(stream, entry.file_size)
        return arrays


def _header(stream: IO[bytes], size: int) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
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


def _read(stream: IO[bytes], size: int) -> np.ndarray:
    """Return the .npy array of ``size`` bytes in a stream."""
    shape, by_columns, dtype = _header(stream, size)
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


def check_array(arrays: Mapping[str, Any], name: str, kinds: str, shape: tuple[int, ...], finite: bool = True) -> None:
    """Raise ValueError if an array is missing, has another kind or shape, or contains a NaN or an infinity."""
    values = arrays.get(name)
    if values is None:
        raise ValueError(f'has no array "{name}"')
    if values.dtype.kind not in kinds or values.shape != shape:
        raise ValueError(f'"{name}" has shape {values.shape}, {values.dtype}; expected {shape}')
    if finite and not np.all(np.isfinite(values)):
        raise ValueError(f'"{name}" contains a NaN or an infinity')


def from_json(made: type[T], values: Any) -> T:
    """Return an object of a dataclass made from a JSON value. Its fields are numbers, strings, Booleans or None.

    Raises ValueError for a missing field or one of another type, and the exceptions of the class.
    """
    known = {field.name: str(field.type).split(" | ") for field in fields(cast(Any, made))}
    if not isinstance(values, dict) or set(values) != set(known):
        raise ValueError(f"found {values!r:.80}, expected the fields {', '.join(known)}")
    for name, types in known.items():
        value = values[name]
        kind = "None" if value is None else type(value).__name__
        if kind not in types and not (kind == "int" and "float" in types):
            raise ValueError(f"{name} is {value!r:.80}, expected {' or '.join(types)}")
    return made(**values)
