"""Reading what a map or a word model stores: rows of .npy files, checked arrays, and dataclasses in JSON."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from netspec.errors import InputError
from netspec.files.arrays import opened, read_array, read_header

T = TypeVar("T")


def read_npy(path: str | Path, expected: str) -> np.ndarray:
    """Return the array of an .npy file. Raises InputError, with ``expected``, for any other file."""
    with opened(Path(path), expected) as stream:
        return read_array(stream, os.fstat(stream.fileno()).st_size)


class Rows:
    """The array (N, ...) of an .npy file. ``rows[first:end]`` reads only these rows.

    The file is not memory-mapped, because reading a mapped file that was truncated meanwhile ends the process. Raises
    InputError, with ``expected``, for any other file.
    """

    def __init__(self, path: str | Path, expected: str) -> None:
        self._path, self._expected = regular(path, expected), expected
        with opened(self._path, expected) as stream:
            self.shape, by_columns, self.dtype = read_header(stream, os.fstat(stream.fileno()).st_size)
            self._start = stream.tell()
            if by_columns or not self.shape:
                raise ValueError("an array that is not stored in row-major (C) order")
        self.size = math.prod(self.shape)

    def __getitem__(self, rows: slice) -> np.ndarray:
        first, end, _ = rows.indices(self.shape[0])
        shape = (max(0, end - first), *self.shape[1:])
        width = math.prod(self.shape[1:]) * self.dtype.itemsize
        with opened(self._path, self._expected) as stream:
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
