"""HDF5 files, written whole.

h5py writes into a Python file here. Where HDF5's own driver meets a full disk, the library keeps what it could not
write, tries again when the process ends, and kills it.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from netspec.whole_file import whole_file


@contextmanager
def new_hdf5(path: str | Path) -> Iterator[h5py.File]:
    """Yield a new HDF5 file, which appears at ``path`` at the end of the block; see :func:`whole_file`."""
    with whole_file(path) as unfinished, _Patient(unfinished) as stream:
        with h5py.File(stream, "w") as file:
            yield file
        stream.check()


class _Patient(io.FileIO):
    """A file to read and write whose first error is kept: the library is told that all went well."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+b")
        self._fault: OSError | None = None

    def check(self) -> None:
        """Raise the first error that came."""
        if self._fault is not None:
            raise self._fault

    def write(self, data: memoryview) -> int:  # type: ignore[override]
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while len(rest) and self._fault is None:  # a write to a file may be cut short
                rest = rest[super().write(rest) :]
        except OSError as fault:
            self._fault = fault
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as fault:
            self._fault = self._fault or fault
            return size or 0

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as fault:
            self._fault = self._fault or fault
