"""The records of a database, one by one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import torch
from torch.utils.data import Dataset
from typing_extensions import override

from netspec.data.hdf5 import Hdf5Source
from netspec.datasets.opened import Opened, PerProcess
from netspec.errors import SpecError
from netspec.graph.options import BuildOptions
from netspec.layers.contract.context import Context
from netspec.layers.data.files import BACKENDS, ReadingLayer
from netspec.net.one_layer import make_layer
from netspec.proto.schema import LayerParameter, phase_of
from netspec.proto.text import write_text


class Records(Dataset[tuple[torch.Tensor, ...]]):
    """The records of an LMDB, a LevelDB, an HDF5 file, or a list of HDF5 files, in Caffe's order.

    An item is what Caffe's Data layer makes of a record: the image (C, H, W) float32, transformed, and its label, a
    float32 scalar. ``transform`` is what a prototxt has between the braces of ``transform_param { }``; ``phase`` says
    whether crops are random. Mirrors and crops are drawn again in each epoch, which :meth:`set_epoch` sets. Of HDF5
    files, which Caffe does not transform, an item has a row of each of the datasets ``tops``. A layer "data" of a net
    with the same ``seed`` draws the same. Raises SpecError for faults of the files.

        >>> records = Records("train_lmdb", "crop_size: 32 mirror: true mean_value: 104")
        >>> image, label = records[0]
        >>> len(records), image.shape, label.shape
        (6, torch.Size([3, 32, 32]), torch.Size([]))
    """

    def __init__(
        self,
        source: str | Path,
        transform: str = "",
        phase: str = "TRAIN",
        *,
        seed: int = 0,
        tops: Sequence[str] = ("data", "label"),
    ) -> None:
        path = Path(source)
        if path.is_file():
            if transform:
                raise SpecError("Caffe does not transform data of HDF5 files; leave out transform")
            opener = partial(_open_hdf5, str(source), tuple(tops))
        else:
            opener = partial(_open_database, str(source), transform, phase, seed)
        self._opened = PerProcess(opener)
        self._count = self._opened()[0].cursor.count
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # workers that stay see a change

    def __len__(self) -> int:
        return self._count

    @override
    def __getitem__(self, number: int) -> tuple[torch.Tensor, ...]:
        arrays = self._opened()[0].batch(self._position(number))
        return tuple(torch.from_numpy(array)[0] for array in arrays)

    def key(self, number: int) -> str:
        """Return the key of a record."""
        return self._opened()[0].keys(self._position(number))[0]

    def set_epoch(self, epoch: int) -> None:
        """Draw mirrors and crops as Caffe does when it reads the records for the ``epoch``-th time, from 0."""
        self._epoch.fill_(epoch)

    def _position(self, number: int) -> int:
        if not -self._count <= number < self._count:
            raise IndexError(f"found record {number}, expected less than {self._count}")
        return int(self._epoch) * self._count + number % self._count


def _open_database(source: str, transform: str, phase: str, seed: int) -> Opened:
    backend = "leveldb" if (Path(source) / "CURRENT").is_file() else "lmdb"
    param: Any = LayerParameter(name="data", type="Data", top=["data", "label"])
    param.data_param.source, param.data_param.batch_size = source, 1
    param.data_param.backend = BACKENDS.index(backend)
    text = f"transform_param {{ {transform} }} {write_text(param)}"
    layer = make_layer(text, [], Context(phase_of(phase), BuildOptions(data_seed=seed)))
    assert isinstance(layer, ReadingLayer)
    return layer.source, tuple(layer.param.top)


def _open_hdf5(source: str, tops: tuple[str, ...]) -> Opened:
    files = [source] if h5py.is_hdf5(source) else source
    return Hdf5Source(files, tops, 1), tops
