"""Reading the weights of a .caffemodel or .caffemodel.h5 without a net."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from netspec.data.blobs import is_legacy, to_array
from netspec.errors import SpecError, Where
from netspec.files.hdf5 import layer_groups, open_hdf5
from netspec.proto.binary import read_net_binary


@dataclass(frozen=True)
class StoredLayer:
    """The weights of a layer in a file. HDF5 files have no ``type``. ``legacy``: shapes are 4-D, as in old files."""

    name: str
    type: str
    blobs: tuple[np.ndarray, ...]
    legacy: bool = False


def stored_layers(path: str | Path) -> list[StoredLayer]:
    """Return the layers with weights, in the net's order (HDF5: in alphabetical order). Raises SpecError."""
    if h5py.is_hdf5(path):
        return list(_hdf5_layers(path))
    layers = []
    for layer in read_net_binary(path).layer:
        if layer.blobs:
            try:
                blobs = tuple(to_array(blob) for blob in layer.blobs)
            except ValueError as fault:
                raise SpecError(str(fault), Where(str(path), layer=layer.name, type=layer.type)) from None
            layers.append(StoredLayer(layer.name, layer.type, blobs, is_legacy(layer.blobs[0])))
    return layers


def _hdf5_layers(path: str | Path) -> Iterator[StoredLayer]:
    with open_hdf5(path) as file:
        data = file.group("data")
        if data is None:
            raise SpecError("this is not a weights file: the HDF5 file has no group /data")
        for name, arrays in layer_groups(data):
            if arrays:
                yield StoredLayer(name, "", tuple(np.asarray(arrays[key][()]) for key in sorted(arrays, key=_number)))


def _number(key: str) -> tuple[int, str]:
    return (int(key), "") if key.isdigit() else (1 << 31, key)
