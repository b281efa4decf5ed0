"""Safe reading of HDF5 files, and writing them completely or not at all.

The library follows links to any file of the machine, allocates any declared size, and raises many kinds of exceptions.

Files are written by h5py into a Python file object. With HDF5's own driver, the library keeps data that did not fit on
a full disk, tries to write it again when the process exits, and crashes.
"""

from __future__ import annotations

import io
import math
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5z  # pyright: ignore[reportAttributeAccessIssue]

from netspec.errors import SpecError, Where
from netspec.files.kinds import head_of, pointer_fault
from netspec.files.limits import ALWAYS_ALLOWED, bomb
from netspec.files.whole_file import whole_file

_MOST_DEFLATED = 1032  # times its size: the most that deflate can expand data
_FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32, h5z.FILTER_LZF}
LIBRARY_FAULTS = (OSError, RuntimeError, LookupError, ValueError, TypeError, ArithmeticError, MemoryError)


@contextmanager
def open_hdf5(path: str | Path, where: Where | None = None) -> Iterator[Hdf5Group]:
    """Yield the root group of an HDF5 file. Errors within the block become a SpecError at ``where``.

    Links, and datasets stored in other files, are refused.
    """
    named = f'HDF5 file "{path}" ' if where else ""
    where = where or Where(str(path))
    try:
        with h5py.File(path, "r") as file:
            yield Hdf5Group(file, os.path.getsize(path))
    except SpecError as fault:
        raise fault if fault.where else SpecError(named + fault.message, where) from None
    except LIBRARY_FAULTS as fault:  # HDF5's message contains errno three times
        known = os.strerror(fault.errno) if isinstance(fault, OSError) and fault.errno else ""
        reason = known or " ".join(str(fault).split()) or type(fault).__name__
        raise SpecError(named + (pointer_fault(head_of(path)) or f"cannot be read: {reason}"), where) from None


class Hdf5Group:
    """A group of an HDF5 file. Its methods raise SpecError without a location."""

    def __init__(self, group: Any, file_size: int, path: str = "") -> None:
        self._group, self._file_size, self._path = group, file_size, path

    def names(self) -> list[str]:
        """Return the names of the members, in the library's (alphabetical) order."""
        return list(self._group)

    def group(self, name: str) -> Hdf5Group | None:
        """Return a member, or a member of a member (``a/b``), that is a group; None if there is none."""
        found = self._member(name)
        if not isinstance(found, h5py.Group):
            return None
        if self._path.count("/") > 50:
            raise SpecError(f"group {self._path}/{name} is too deep; does it contain itself?")
        return Hdf5Group(found, self._file_size, f"{self._path}/{name}")

    def dataset(self, name: str) -> h5py.Dataset | None:
        """Return a member that is a dataset of this file with a plausible size, or None if there is none.

        The size of the whole dataset is checked, even if only slices are read later.
        """
        found = self._member(name)
        if not isinstance(found, h5py.Dataset):
            return None
        fault = bomb(found.nbytes, self._file_size) or _wrong_chunks(found)
        if found.external or found.is_virtual:
            fault = "is stored in another file; this is not supported"
        if fault:
            raise SpecError(f"dataset {self._path}/{name} {fault}")
        return found

    def values(self, name: str) -> np.ndarray:
        """Return the numbers of a dataset, or its text as an array of bytes."""
        found = self.dataset(name)
        if found is None:
            raise SpecError(f"has no dataset {self._path}/{name}")
        values = np.asarray(found[()])
        if values.dtype.kind not in "fiubSO":
            raise SpecError(f"dataset {self._path}/{name} holds {values.dtype}, expected numbers")
        return values

    def _member(self, name: str) -> Any:
        found: Any = self._group
        for part in filter(None, name.split("/")):
            link = found.get(part, getlink=True) if isinstance(found, h5py.Group) else None
            if link is None:
                return None
            if not isinstance(link, h5py.HardLink):
                raise SpecError(f"{self._path}/{name} is a link; this is not supported")
            found = found[part]
        return found


def _wrong_chunks(dataset: h5py.Dataset) -> str:
    """Return an error in a dataset's chunks, or "": the library allocates the size to which a chunk decompresses."""
    packing = dataset.id.get_create_plist()
    filters = [packing.get_filter(i)[0] for i in range(packing.get_nfilters())]
    if set(filters) - _FILTERS or filters.count(h5z.FILTER_DEFLATE) > 1:
        return "has an unsupported compression; write it with gzip, lzf, or uncompressed"
    stored: list[Any] = []
    if dataset.chunks is not None:
        dataset.id.chunk_iter(stored.append)
    most = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize * 9 // 8 + 4096  # packed, noise grows a little
    for chunk in stored:
        size = chunk.size
        if size <= most and h5z.FILTER_DEFLATE in filters and size * _MOST_DEFLATED > ALWAYS_ALLOWED:
            mask, data = dataset.id.read_direct_chunk(chunk.chunk_offset)
            size = len(zlib.decompressobj().decompress(data, most + 1)) if not mask else size
        if size > most:
            return f"has a chunk of more than its {most} bytes"
    return ""


def layer_groups(data: Hdf5Group, prefix: str = "") -> Iterator[tuple[str, dict[str, h5py.Dataset]]]:
    """Yield the layers of a weights file, /data/<layer>/<i>, in Caffe's (alphabetical) order.

    A layer with a slash in its name is a group within a group.
    """
    for name in data.names():
        group = data.group(name)
        if group is not None:
            found = {key: group.dataset(key) for key in group.names()}
            arrays = {key: dataset for key, dataset in found.items() if dataset is not None}
            if arrays or not found:
                yield prefix + name, arrays
            yield from layer_groups(group, f"{prefix}{name}/")


@contextmanager
def new_hdf5(path: str | Path) -> Iterator[h5py.File]:
    """Yield a new HDF5 file. It appears at ``path`` at the end of the block; see :func:`whole_file`."""
    with whole_file(path) as unfinished, hdf5_in(unfinished) as file:
        yield file


@contextmanager
def hdf5_in(unfinished: Path) -> Iterator[h5py.File]:
    """Yield a new HDF5 file at an existing path. Raises OSError if it cannot be written."""
    with _Patient(unfinished, "w+b") as stream:
        with h5py.File(stream, "w") as file:
            yield file
        if stream.fault is not None:
            raise stream.fault


class _Patient(io.FileIO):
    """A file that stores its first error and does not raise it in the library."""

    fault: OSError | None = None

    def write(self, data: memoryview) -> int:  # type: ignore[override]
        rest = memoryview(data).cast("B")
        with self._stored():
            while len(rest) and self.fault is None:  # a write can be incomplete
                rest = rest[super().write(rest) :]
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        with self._stored():
            return super().truncate(size)
        return size or 0

    def flush(self) -> None:
        with self._stored():
            super().flush()

    @contextmanager
    def _stored(self) -> Iterator[None]:
        try:
            yield
        except OSError as fault:
            self.fault = self.fault or fault
