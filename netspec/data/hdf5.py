"""Reading rows of HDF5 files, and writing results to one.

Caffe: src/caffe/layers/hdf5_data_layer.cpp, src/caffe/layers/hdf5_output_layer.cpp
"""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import lru_cache
from typing import Any

import h5py
import numpy as np

from netspec import log
from netspec.data.images import list_lines
from netspec.data.random_words import permutation
from netspec.data.sources import ALONE, Arrays, Cursor, Draws, Shape
from netspec.errors import SpecError, Where
from netspec.files.hdf5 import new_hdf5, open_hdf5

_FILES_IN_MEMORY = 2  # files to keep in memory; Caffe keeps one, but a batch can span two


class Hdf5Source:
    """The datasets named after the tops, row by row, from the files in a list (separated by spaces).

    ``files`` is the path of the list, or the paths of the files. A batch can span files. With ``shuffle``, each epoch
    has a different order of files, and of the rows within each file. Raises SpecError for a missing file or dataset,
    and if rows differ in shape between files.
    """

    def __init__(
        self,
        files: str | Sequence[str],
        tops: Sequence[str],
        batch_size: int,
        shuffle: bool = False,
        draws: Draws = ALONE,
        where: Where | None = None,
    ) -> None:
        named = _listed(files, where) if isinstance(files, str) else [(name, Where(name)) for name in files]
        self._tops = tuple(tops)
        self._files = [name for name, _ in named]
        self._wheres = [where for _, where in named]
        self._row_shapes = _row_shapes(*named[0], self._tops)[1]
        counts = [self._rows_of(name, where) for name, where in named]
        self._starts = np.cumsum([0, *counts])
        self.cursor = Cursor(int(self._starts[-1]), batch_size, draws=draws)
        self._shuffle, self._draws = shuffle, draws
        self._order = lru_cache(maxsize=2)(self._order_of)
        self._load = lru_cache(maxsize=_FILES_IN_MEMORY)(self._load_file)
        self._lock = threading.Lock()

    @property
    def shapes(self) -> Sequence[Shape]:
        """The shapes of all tops."""
        return [(self.cursor.batch_size, *shape) for shape in self._row_shapes]

    def batch(self, iteration: int) -> Arrays:
        """Return the tops of an iteration, float32."""
        return self.together(iteration, 1)

    def together(self, iteration: int, count: int) -> Arrays:
        """Return the tops of several iterations; see :func:`netspec.data.sources.batches`."""
        rows = self._rows(iteration, count)
        files = np.searchsorted(self._starts, rows, side="right") - 1
        tops = tuple(np.empty((len(rows), *shape), np.float32) for shape in self._row_shapes)
        for file in np.unique(files):
            here = files == file
            with self._lock:
                datasets = self._load(int(file))
            for top, dataset in zip(tops, datasets, strict=True):
                top[here] = dataset[rows[here] - self._starts[file]]
        return tops

    def keys(self, iteration: int) -> list[str]:
        """Return ``file:row`` of each row of an iteration."""
        rows = self._rows(iteration)
        files = np.searchsorted(self._starts, rows, side="right") - 1
        return [f"{self._files[f]}:{row - self._starts[f]}" for f, row in zip(files, rows, strict=True)]

    def _rows(self, iteration: int, count: int = 1) -> np.ndarray:
        """Return the indices of the rows of iterations, counted through all files."""
        rows = self.cursor.count
        positions = np.array(self.cursor.positions(iteration, count))
        if not self._shuffle:
            return positions % rows
        return np.array([self._order(epoch)[i] for epoch, i in zip(positions // rows, positions % rows, strict=True)])

    def _order_of(self, epoch: int) -> np.ndarray:
        seed, stream = self._draws.seed, f"{self._draws.stream}/shuffle/{epoch}"
        rows = []
        for file in permutation(seed, stream, len(self._files)):
            start, end = self._starts[file : file + 2]
            rows.append(start + permutation(seed, f"{stream}/{file}", int(end - start)))
        return np.concatenate(rows)

    def _load_file(self, file: int) -> Arrays:
        with open_hdf5(self._files[file], self._wheres[file]) as opened:
            arrays = tuple(opened.values(top).astype(np.float32) for top in self._tops)
            rows = int(self._starts[file + 1] - self._starts[file])
            if any(array.shape != (rows, *shape) for array, shape in zip(arrays, self._row_shapes, strict=True)):
                raise SpecError("was changed by another program while it was being read")
            return arrays

    def _rows_of(self, name: str, where: Where) -> int:
        count, shapes = _row_shapes(name, where, self._tops)
        if shapes != self._row_shapes:
            message = f'rows of "{name}" have shapes {shapes}, those of "{self._files[0]}" have {self._row_shapes}'
            raise SpecError(f"{message}; all files must agree", where)
        return count


def _listed(path: str, where: Where | None) -> list[tuple[str, Where]]:
    """Return the files in a list, and their positions in it. Raises SpecError if there are none."""
    log.info("hdf5_data_layer.cpp:80", f"Loading list of HDF5 filenames from: {path}")
    if os.path.isfile(path) and h5py.is_hdf5(path):
        message = f'"{path}" is an HDF5 file; expected a text file that lists HDF5 files, one in each line'
        raise SpecError(message, where or Where(path))
    named = [(name, position) for line, position in list_lines(path, where) for name in line.split()]
    log.info("hdf5_data_layer.cpp:94", f"Number of HDF5 files: {len(named)}")
    if not named:
        raise SpecError(f'the list "{path}" names no HDF5 file', where or Where(path))
    return named


def _row_shapes(name: str, where: Where, tops: Sequence[str]) -> tuple[int, list[Shape]]:
    """Return the number of rows and the shape of a row of each dataset."""
    with open_hdf5(name, where) as file:
        datasets: list[h5py.Dataset] = []
        for top in tops:
            dataset = file.dataset(top)
            if dataset is None:
                found = ", ".join(f'"{key}"' for key in file.names()) or "nothing"
                raise SpecError(f'has no dataset "{top}", the name of a top; it has {found}')
            datasets.append(dataset)
            if dataset.ndim == 0 or dataset.dtype.kind not in "fiu":
                found = "has no rows" if dataset.ndim == 0 else f"has values of type {dataset.dtype}"
                raise SpecError(f'dataset "{top}" of "{name}" {found}; expected rows of numbers', where)
        counts = [len(dataset) for dataset in datasets]
        if min(counts) != max(counts) or not counts[0]:
            raise SpecError(f'datasets of "{name}" have {counts} rows; expected equal numbers, above 0', where)
        return counts[0], [tuple(dataset.shape[1:]) for dataset in datasets]


class Hdf5Sink:
    """A new HDF5 file with growing datasets ``data`` and ``label``, both 4-D as in Caffe.

    Caffe stops at the second batch, because its datasets already exist; here batches are appended. The file is renamed
    to its path when the sink is closed or deleted; without a batch, no file is written. Raises SpecError, and keeps an
    older file, if the file cannot be written or a batch has a different shape.
    """

    NAMES = ("data", "label")

    def __init__(self, path: str, where: Where | None = None) -> None:
        self._path, self._where = path, where
        self._writing: AbstractContextManager[h5py.File] | None = None
        self._unused: Any = None

    def append(self, data: np.ndarray, label: np.ndarray) -> None:
        """Add the rows of a batch."""
        log.info("hdf5_output_layer.cpp:31", f"Saving HDF5 file {self._path}")
        if self._writing is None:
            self._open()
        try:
            for name, values in zip(self.NAMES, (data, label), strict=True):
                self._append(name, values.reshape(values.shape + (1,) * (4 - values.ndim)).astype(np.float32))
        except SpecError as fault:
            self._end(fault)
            raise
        log.info("hdf5_output_layer.cpp:36", f"Successfully saved {len(data)} rows")

    def close(self) -> None:
        """Complete the file and rename it to its path."""
        self._end()

    def _open(self) -> None:
        writing = new_hdf5(self._path)
        with self._with_position():
            self._file = writing.__enter__()
        self._writing = writing
        self._unused = weakref.finalize(self, _end_unused, writing)

    def _append(self, name: str, rows: np.ndarray) -> None:
        if name not in self._file:
            self._file.create_dataset(name, data=rows, maxshape=(None, *rows.shape[1:]), chunks=True)
            return
        dataset = self._file[name]
        assert isinstance(dataset, h5py.Dataset)
        if dataset.shape[1:] != rows.shape[1:]:
            message = f'rows of "{name}" had shape {dataset.shape[1:]} in earlier batches, found {rows.shape[1:]}'
            raise SpecError(message, self._where)
        dataset.resize(len(dataset) + len(rows), axis=0)
        dataset[-len(rows) :] = rows

    def _end(self, fault: SpecError | None = None) -> None:
        """Close the file; rename it to its path, or remove it after an error."""
        writing, self._writing = self._writing, None
        if writing is not None:
            self._unused.detach()
            with self._with_position():
                writing.__exit__(None if fault is None else type(fault), fault, None)

    @contextmanager
    def _with_position(self) -> Iterator[None]:
        """Raise an error with the position in the prototxt that names the file."""
        try:
            yield
        except SpecError as fault:
            raise SpecError(f'HDF5 file "{self._path}" {fault.message}', self._where) from None


def _end_unused(writing: AbstractContextManager[h5py.File]) -> None:
    try:
        writing.__exit__(None, None, None)
    except SpecError as fault:
        log.logger.warning(fault)
