"""Reading the weights of a .caffemodel or .caffemodel.h5 without a net."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from netspec.data.blobs import to_array
from netspec.errors import SpecError, Where
from netspec.files.hdf5 import layer_groups, open_hdf5
from netspec.proto.binary import read_net_binary


def stored_weights(path: str | Path) -> dict[str, list[np.ndarray]]:
    """Return the blobs of each layer that has any, in the net's order (HDF5: in alphabetical order).

    Raises SpecError for a file that is damaged, or neither a .caffemodel nor a .caffemodel.h5, or has no weights.
    """
    found = _of_hdf5(path) if h5py.is_hdf5(path) else _of_binary(path)
    if not found:
        raise SpecError("holds no weights", Where(str(path)))
    return found


def _of_binary(path: str | Path) -> dict[str, list[np.ndarray]]:
    found = {}
    for layer in read_net_binary(path).layer:
        try:
            found[layer.name] = [to_array(blob) for blob in layer.blobs]
        except ValueError as fault:
            raise SpecError(str(fault), Where(str(path), layer=layer.name, type=layer.type)) from None
    return {name: blobs for name, blobs in found.items() if blobs}


def _of_hdf5(path: str | Path) -> dict[str, list[np.ndarray]]:
    with open_hdf5(path) as file:
        data = file.group("data")
        if data is None:
            raise SpecError("this is not a weights file: the HDF5 file has no group /data")
        return {
            name: [np.asarray(arrays[key][()]) for key in sorted(arrays, key=_number)]
            for name, arrays in layer_groups(data)
            if arrays
        }


def _number(key: str) -> tuple[int, str]:
    return (int(key), "") if key.isdigit() else (1 << 31, key)
