"""Arrays of .npz and .npy files, read with care.

numpy makes room for what a header announces before it reads, and a small packed file may unpack to any size: both are
checked here against what the file holds. Of Python objects only lists of numbers are unpickled, by :func:`read_lists`.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import re
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, BinaryIO, TypeVar, cast

import numpy as np

from netspec.errors import InputError
from netspec.files.limits import ALWAYS, MOST_PACKED

T = TypeVar("T")
_FAULTS = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, SyntaxError),
    *(EOFError, NotImplementedError, RuntimeError, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
    *(struct.error, pickle.UnpicklingError, SystemError),
)


@contextmanager
def _opened(path: Path, expected: str) -> Iterator[BinaryIO]:
    """Yield a file. Raises InputError, which says what was expected, for what cannot be read within the block."""
    try:
        with path.open("rb") as stream:
            yield stream
    except _FAULTS as error:
        raise _fault(error, path, expected) from None


def read_npz(path: str | Path, expected: str) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file, by name.

    Raises InputError, which says what was expected, for any other file.
    """
    with _opened(Path(path), expected) as stream:
        if stream.seekable():
            return unpack(stream, os.fstat(stream.fileno()).st_size)
        data = stream.read()  # a pipe
        return unpack(io.BytesIO(data), len(data))


def read_npy(path: str | Path, expected: str) -> np.ndarray:
    """Return the array of an .npy file. Raises InputError, which says what was expected, for any other file."""
    with _opened(Path(path), expected) as stream:
        return _read(stream, os.fstat(stream.fileno()).st_size)


def map_npy(path: str | Path, expected: str) -> np.ndarray:
    """Return the array of an .npy file as :func:`read_npy`, but each part read from disk only when it is used."""
    with _opened(Path(path), expected) as stream:
        shape, by_columns, dtype = _header(stream, os.fstat(stream.fileno()).st_size)
        if not math.prod(shape):
            return np.zeros(shape, dtype)
        order = "F" if by_columns else "C"
        return np.asarray(np.memmap(stream, dtype, "r", stream.tell(), shape, order))


def read_lists(path: str | Path) -> list[Any] | None:
    """Return the lists in an .npy file whose elements are lists or arrays of integers; None for a plain array.

    Such a file is a pickle, which could run anything: here it may hold integers, lists, tuples and arrays of them, and
    nothing else. Raises InputError for other files.
    """
    with _opened(Path(path), "an array of numbers, or of lists of integers") as stream:
        shape, _, dtype = _described(stream)
        if not dtype.hasobject:
            return None
        found = _Lists(stream).load()
        if not isinstance(found, _Array) or found.values.shape != shape:
            raise ValueError("another array than its header says")
        return _plain(found)


class _Lists(pickle._Unpickler):  # pyright: ignore[reportAttributeAccessIssue]
    """Unpickles numpy arrays and lists; whatever else a pickle names is refused.

    What numpy itself would rebuild from a damaged pickle may end the process, and so may the memory that the unpickler
    in C takes for a large number: this one is in Python, and :class:`_Array` stands for numpy's.
    """

    def find_class(self, module: str, name: str) -> Any:
        if module in ("numpy", "numpy.core.multiarray", "numpy._core.multiarray") and name in _KNOWN:
            return _KNOWN[name]
        raise pickle.UnpicklingError(f"{module}.{name} is no list of numbers")


class _Kind:
    """A dtype in a pickle, by its code: ``O8``, or one of numbers such as ``i8``."""

    def __init__(self, code: str, *_: Any) -> None:
        if not re.fullmatch(r"O8?|[biuf][1248]", code):
            raise ValueError(f"an array of {code!r:.40}")
        self.code, self.order = code, "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = {">": ">"}.get(state[1], "<")

    def numbers(self, data: bytes) -> np.ndarray:
        """Return what the bytes hold."""
        if self.code[0] == "O":
            raise ValueError("a number of Python objects")
        return np.frombuffer(data, np.dtype(self.order + self.code))


class _Array:
    """An array in a pickle: ``values`` are known when its state is read."""

    def __init__(self, *_: Any) -> None:
        self.values = np.empty(0, object)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, by_columns, data = state
        if kind.code[0] == "O":
            values = np.empty(len(data), object)
            for i, each in enumerate(data):
                values[i] = each
        else:
            values = kind.numbers(data)
        self.values = values.reshape(shape, order="F" if by_columns else "C")


_KNOWN: dict[str, Any] = {
    "ndarray": _Array,
    "dtype": _Kind,
    "_reconstruct": _Array,
    "scalar": lambda kind, data: kind.numbers(data)[0],
}


def _plain(value: Any) -> Any:
    """Return integers and lists of them for what numpy has. Raises ValueError for other values."""
    if isinstance(value, _Array):
        value = value.values.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (float, np.floating)) and float(value).is_integer():
        return int(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    raise ValueError(f"a {type(value).__name__}")


def unpack(packed: IO[bytes], stored: int) -> dict[str, np.ndarray]:
    """Return the arrays of an open .npz of ``stored`` bytes; raises what zipfile and numpy raise."""
    with zipfile.ZipFile(packed) as archive:
        entries = archive.infolist()
        size = sum(entry.file_size for entry in entries)
        if size > ALWAYS and size > MOST_PACKED * stored:
            raise ValueError(f"its arrays would take {size / 2**20:.0f} MiB of memory, in a file of {stored} bytes")
        arrays: dict[str, np.ndarray] = {}
        for entry in entries:
            with archive.open(entry) as stream:
                arrays[entry.filename.removesuffix(".npy")] = _read(stream, entry.file_size)
        return arrays


def _described(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return what the header of an array in the format .npy says."""
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"an array of format {version}")
    return (np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0)(stream)


def _header(stream: IO[bytes], size: int) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, order by columns, and dtype of an array in the format .npy, of ``size`` bytes in a stream."""
    shape, by_columns, dtype = _described(stream)
    if dtype.hasobject:
        raise ValueError("an array of Python objects")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"an array of shape {shape}, {dtype}, in {size} bytes")
    return shape, by_columns, dtype


def _read(stream: IO[bytes], size: int) -> np.ndarray:
    """Return the array in the format .npy, of ``size`` bytes, that a stream holds."""
    shape, by_columns, dtype = _header(stream, size)
    count = math.prod(shape)
    data = stream.read(count * dtype.itemsize)
    values = np.frombuffer(data, dtype, count).copy() if dtype.itemsize else np.zeros(count, dtype)
    if dtype.kind == "U" and np.any(values.view(np.dtype(np.uint32).newbyteorder(dtype.byteorder)) > sys.maxunicode):
        raise ValueError("an array of characters that Unicode does not have")  # Python's strings would be broken
    return values.reshape(shape[::-1]).T if by_columns else values.reshape(shape)


def _fault(error: BaseException, path: Path, expected: str) -> InputError:
    if not path.exists():
        return InputError(f"no such file; expected {expected}", path)
    if isinstance(error, InputError):
        return error
    reason = " ".join(str(error).split())
    if not reason or isinstance(error, LookupError):
        reason = f"{type(error).__name__} {reason}".rstrip()
    return InputError(f"cannot be read ({reason}); expected {expected}", path)


def check_array(
    arrays: dict[str, np.ndarray], name: str, kinds: str, shape: tuple[int, ...], finite: bool = True
) -> None:
    """Raise ValueError for an array that is missing, of another kind or shape, or has a number that is not finite."""
    values = arrays.get(name)
    if values is None:
        raise ValueError(f'has no array "{name}"')
    if values.dtype.kind not in kinds or values.shape != shape:
        raise ValueError(f'"{name}" has shape {values.shape}, {values.dtype}; expected {shape}')
    if finite and not np.all(np.isfinite(values)):
        raise ValueError(f'"{name}" has a number that is not finite')


def from_json(made: type[T], values: Any) -> T:
    """Return an object of a dataclass whose fields are numbers, texts, truth values, or None, from what JSON has of it.

    Raises ValueError for a field that is missing or of another type, and what the class itself raises.
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
