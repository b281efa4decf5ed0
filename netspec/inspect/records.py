"""Reading the records of a database or of HDF5 files one by one for inspection, including damaged ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import h5py
import numpy as np

from netspec.data.database import Reader, open_reader
from netspec.data.datum import datum_to_array, parse_datum
from netspec.data.images import list_lines
from netspec.data.random_words import words
from netspec.errors import SpecError, Where
from netspec.files.hdf5 import open_hdf5

_NUMBERS = "biuf"  # kinds of numpy types
_SIGNATURES = {b"\xff\xd8\xff": "JPEG", b"\x89PNG": "PNG", b"BM": "BMP", b"II*\0": "TIFF", b"MM\0*": "TIFF"}


@dataclass(frozen=True)
class Record:
    """A record: its key, values (C, H, W) uint8 or float32, and label or None.

    ``kind`` describes how the values are stored, and ``size`` is their size in bytes. If a record cannot be read,
    ``fault`` is the reason in one line, and there are no values.
    """

    key: str
    kind: str
    size: int
    values: np.ndarray | None = None
    label: float | None = None
    fault: str = ""


class Records(Protocol):
    """Records by index, in the order in which Caffe reads them."""

    def __len__(self) -> int:
        """Return the number of records."""
        ...

    def __getitem__(self, number: int) -> Record:
        """Return a record."""
        ...


def open_records(path: str | Path) -> Records:
    """Open an LMDB, a LevelDB, an HDF5 file, or a text file that lists HDF5 files.

    Raises SpecError for anything else.
    """
    if Path(path).is_file():
        files = [(str(path), Where(str(path)))] if h5py.is_hdf5(path) else list(_files_of_list(str(path)))
        return _RowRecords(files)
    return _DatumRecords(open_reader(str(path), "leveldb" if (Path(path) / "CURRENT").is_file() else "lmdb"))


def spread(count: int, wanted: int | None) -> list[int]:
    """Return ``wanted`` of the numbers below ``count``, one from each of ``wanted`` equal parts; all if it is None.

    Each is drawn at random from its part, with a fixed seed, since labels often alternate.
    """
    if wanted == 0:
        return []
    if wanted is None or wanted >= count:
        return list(range(count))
    ends = [k * count // wanted for k in range(wanted + 1)]
    draws = words(0, "spread", 0, wanted)[:, 0].tolist()
    return [low + draw % (high - low) for low, high, draw in zip(ends, ends[1:], draws, strict=False)]


class _DatumRecords:
    def __init__(self, reader: Reader) -> None:
        self._reader = reader

    def __len__(self) -> int:
        return len(self._reader)

    def __getitem__(self, number: int) -> Record:
        key = self._reader.key(number).decode(errors="backslashreplace")
        size, kind, label = 0, "unreadable", None
        try:
            stored = self._reader.record(number)
            size = len(stored)
            datum = parse_datum(stored)
            kind = _kind(datum.data) if datum.encoded else "raw bytes" if datum.data else "floats"
            label = float(datum.label) if datum.HasField("label") else None
            return Record(key, kind, size, datum_to_array(datum), label)
        except (SpecError, ValueError) as fault:
            return Record(key, kind, size, None, label, getattr(fault, "message", str(fault)))


class _RowRecords:
    """The rows of HDF5 files: the dataset ``data``, or the one with the most axes, and ``label``."""

    def __init__(self, files: list[tuple[str, Where]]) -> None:
        self._files = files
        self._load = lru_cache(maxsize=1)(self._load_file)
        self._starts = np.cumsum([0, *(len(self._load(k)[0]) for k in range(len(files)))])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, number: int) -> Record:
        file = int(np.searchsorted(self._starts, number, side="right")) - 1
        row = number - int(self._starts[file])
        data, labels = self._load(file)
        values = _as_image(data[row])
        label = None if labels is None or labels[row].size != 1 else float(labels[row].reshape(())[()])
        return Record(f"{self._files[file][0]}:{row}", str(data.dtype), data[row].nbytes, values, label)

    def _load_file(self, number: int) -> tuple[np.ndarray, np.ndarray | None]:
        name, where = self._files[number]
        with open_hdf5(name, where) as file:
            names = [each for each in file.names() if (found := file.dataset(each)) is not None and found.ndim]
            if not names:
                raise SpecError("contains no dataset with rows")
            axes = {each: getattr(file.dataset(each), "ndim", 0) for each in names}
            chosen = "data" if "data" in names else max(names, key=lambda each: axes[each])
            data = file.values(chosen)
            if data.dtype.kind not in _NUMBERS:
                raise SpecError(f'dataset "{chosen}" has values of type {data.dtype}, expected numbers')
            labels = file.values("label") if "label" in names and chosen != "label" else None
            if labels is not None and (len(labels) != len(data) or labels.dtype.kind not in _NUMBERS):
                labels = None
        return data, labels


def _files_of_list(path: str) -> Iterator[tuple[str, Where]]:
    found = [(name, where) for line, where in list_lines(path, Where(path)) for name in line.split()]
    if not found:
        raise SpecError("is empty; expected a database, an HDF5 file, or a list of HDF5 files", Where(path))
    yield from found


def _kind(image: bytes) -> str:
    return next((name for start, name in _SIGNATURES.items() if image.startswith(start)), "encoded")


def _as_image(row: np.ndarray) -> np.ndarray:
    """Return a row as (C, H, W): a vector is (D, 1, 1)."""
    values = row if row.dtype == np.uint8 else row.astype(np.float32)
    if values.ndim < 2:
        return values.reshape(-1, 1, 1)
    return values.reshape(-1, *values.shape[-2:])
