"""Loads and saves the weights of a net: in Caffe's binary form, and in its HDF5 form (``.h5``). Also loads safetensors.

Layers of a file and of a net belong together if they have the same name.

Caffe: Net::CopyTrainedLayersFrom, Net::ToProto, Net::ToHDF5 (src/caffe/net.cpp)
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
import torch

from netspec import log
from netspec.data import blobs
from netspec.errors import Report, SpecError, Where, several
from netspec.files.hdf5 import layer_groups, new_hdf5, open_hdf5
from netspec.files.kinds import head_of, is_safetensors, unreadable
from netspec.files.limits import give_back_freed_memory
from netspec.files.whole_file import write_whole
from netspec.layers.contract.base import Layer, shape_string
from netspec.net.extra_file import check_weights
from netspec.net.net import Net
from netspec.proto.binary import MOST_BYTES, net_without_numbers
from netspec.proto.schema import NetParameter

MOST_NAMES = 20  # layers that a warning names
Copies = list[tuple[Layer, int, np.ndarray | blobs.InFile]]  # the layer, the index of its blob, the values


def load_weights(
    net: Net, path: str | Path | Iterable[str | Path], strict: bool = False, *, need_one: bool = False
) -> None:
    """Copy weights from a .caffemodel, .caffemodel.h5 or .safetensors file into the layers with the same names.

    Several files are loaded in order, and a later one overrides an earlier one. A file with a fault changes nothing in
    the net. Layers that only a file has are ignored, and the log names them. Layers that no file has keep their initial
    values, and a warning names them.

    These faults go to ``net.plan.source.report`` as SpecErrors: a file that cannot be read; a file that is not the one
    that was written with its snapshot; blobs whose number or shapes differ from the net's; with ``strict``, layers that
    no file has; with ``need_one``, files that have weights for none of the layers.
    """
    paths: list[str] = [os.fspath(each) for each in several(path)]  # no Path, which removes a slash of a web address
    loaded: set[int] = set()
    whole = True
    for each in paths:
        faults: list[SpecError] = []
        try:
            check_weights(Path(each))
            if h5py.is_hdf5(each):
                loaded |= _copy(partial(_from_hdf5, net, each), faults.append)
            elif is_safetensors(head_of(each)):
                loaded |= _copy(partial(_from_safetensors, net, each), faults.append)
            else:
                with net_without_numbers(each) as (message, file):
                    loaded |= _copy(partial(_from_message, net, message, each, file), faults.append)
                    if faults and message.name and message.name != net.name:
                        names = f'"{message.name}" (this one is "{net.name}")' if net.name else f'"{message.name}"'
                        belong = f"these weights seem to belong to another net, {names}"
                        faults[0] = SpecError(f"{belong}: {faults[0].message}", faults[0].where)
        except SpecError as fault:
            faults.append(fault)
        for fault in faults:
            net.plan.source.report(fault)
        whole = whole and not faults
    give_back_freed_memory()
    if whole:
        _report_missing(net, loaded, paths, strict, need_one)


def copy_weights(net: Net, message: NetParameter, path: str | Path) -> None:
    """Copy the weights in a message, read from ``path``, into the layers with the same names.

    Other layers are ignored. For SpecErrors see :func:`load_weights`.
    """
    _copy(partial(_from_message, net, message, str(path), None), net.plan.source.report)


def _copy(find: Callable[[Report], Copies], report: Report) -> set[int]:
    """Copy the values that ``find`` returns, if it reports no fault. Return the ids of the net's blobs that it found.

    On the device meta nothing is copied.
    """
    faults: list[SpecError] = []
    copies = find(faults.append)
    for fault in faults:
        report(fault)
    with torch.no_grad():
        for layer, j, values in copies if not faults else ():
            blob = layer.blob(j)
            if blob.is_meta:
                continue
            if isinstance(values, blobs.InFile):
                _read_into(blob, values)
            else:
                with warnings.catch_warnings():  # torch warns of read-only memory, but it is only read here
                    warnings.simplefilter("ignore", UserWarning)
                    blob.copy_(torch.from_numpy(np.ascontiguousarray(values)).view(blob.shape))
    return {id(layer.blobs[j]) for layer, j, _ in copies}


def _read_into(blob: torch.Tensor, values: blobs.InFile) -> None:
    """Copy numbers from their file into a blob. Raises SpecError if the file cannot be read."""
    target = blob if blob.is_contiguous() else torch.empty_like(blob, memory_format=torch.contiguous_format)
    flat = target.view(-1)
    try:
        for start, part in values.parts():
            flat[start : start + len(part)].copy_(torch.from_numpy(part))
    except (OSError, ValueError) as fault:
        raise SpecError(unreadable(values.file.name, fault), Where(values.file.name)) from None
    if target is not blob:
        blob.copy_(target)


def _report_missing(net: Net, loaded: set[int], paths: list[str], strict: bool, need_one: bool) -> None:
    """Warn of layers with a blob that was not loaded, or report an error. Weights in the prototxt count as loaded."""
    learning = [layer for layer in net.layers if len(layer.blobs)]
    missing = [
        layer for layer in learning if not layer.param.blobs and any(id(blob) not in loaded for blob in layer.blobs)
    ]
    if not missing:
        return
    nothing = not any(id(blob) in loaded for layer in learning for blob in layer.blobs)
    files = ", ".join(map(str, paths))
    names = _names([layer.param.name for layer in missing])
    if nothing:
        fault = f"contains weights for none of the net's {len(learning)} layers with weights: {names}"
    else:
        fault = f"lacks weights for {len(missing)} of the net's {len(learning)} layers with weights: {names}"
    if strict or (need_one and nothing):
        advice = "is it the file of another net?" if nothing else "without strict they keep their fillers' values"
        net.plan.source.report(SpecError(f"{fault}; {advice}", Where(files)))
    else:
        log.logger.warning(f"{files}: {fault}; they keep the values of their fillers")


def _names(layers: list[str]) -> str:
    more = f" and {len(layers) - MOST_NAMES} more" if len(layers) > MOST_NAMES else ""
    return ", ".join(layers[:MOST_NAMES]) + more


def save_weights(net: Net, path: str | Path, diff: bool = False) -> None:
    """Write all layers of the net, splits included, and their weights; with ``diff`` also their gradients.

    A file whose name ends in ``.h5`` is HDF5, any other is binary. The binary form has a shared blob in each of its
    layers, HDF5 only in its owner. Raises SpecError if the file cannot be written; an existing file then stays as it
    is.

        >>> net = netspec.load_net("deploy.prototxt", seed=1)
        >>> netspec.save_weights(net, "random.caffemodel")
    """
    (write_hdf5 if str(path).endswith(".h5") else write_binary)(net, path, diff)


def write_binary(net: Net, path: str | Path, diff: bool = False) -> None:
    """Write like :func:`save_weights`, but always in Caffe's binary form."""
    if (size := binary_bytes(net, diff)) > MOST_BYTES:
        raise SpecError(f"cannot be written: {too_large(size)}", Where(str(path)))
    write_whole(path, net_to_proto(net, diff).SerializeToString(deterministic=True))


def binary_bytes(net: Net, diff: bool = False) -> int:
    """Return the size in bytes of the numbers in Caffe's binary form, which is nearly the size of the file."""
    numbers = sum(math.prod(shape) for layer in net.layers for shape in layer.blob_shapes)
    return (2 if diff else 1) * np.dtype(np.float32).itemsize * numbers


def too_large(size: int) -> str:
    """Return the message for a binary file that would be too large."""
    return f"{size / 2**30:.2f} GiB is more than the 2 GiB limit of a binary file; set snapshot_format: HDF5"


def write_hdf5(net: Net, path: str | Path, diff: bool = False) -> None:
    """Write like :func:`save_weights`, but always in HDF5."""
    check_names(net, path)
    shared = _shared(net)
    nested = [layer.param.name for layer in net.layers if "/" in layer.param.name and layer.blobs]
    if nested:
        log.logger.warning(
            f'{path}: Caffe cannot load weights of layers with "/" in their names from HDF5: {_names(nested)}; '
            "for Caffe, write the binary format: .caffemodel without .h5, or snapshot_format: BINARYPROTO"
        )
    with new_hdf5(path) as file:
        data = file.create_group("data")
        diffs = file.create_group("diff") if diff else None
        for layer in reversed(net.layers_by_name().values()):
            name = layer.param.name
            group = data.require_group(name)
            for j in range(len(layer.blobs)):
                if (name, j) not in shared:
                    group.create_dataset(str(j), data=_values(layer, j))
            if diffs is not None:
                group = diffs.require_group(name)
                for j in range(len(layer.blobs)):
                    group.create_dataset(str(j), data=_gradient(layer, j))


def net_to_proto(net: Net, diff: bool = False) -> NetParameter:
    """Return the net as a message: its name, and its layers as they run (with splits and phases) with their blobs."""
    proto = NetParameter(name=net.name)
    for layer in net.layers:
        written = proto.layer.add()
        written.CopyFrom(layer.param)
        if layer.default_loss_weight and layer.num_tops == 1 and not written.loss_weight:
            written.loss_weight.append(1)  # Caffe's loss layers write their default (loss_layer.cpp)
        del written.blobs[:]
        for j in range(len(layer.blobs)):
            if j == len(written.param) and layer.param_spec(j, None).lr_mult == 0:
                written.param.add(lr_mult=0)  # as Caffe's BatchNorm does (batch_norm_layer.cpp)
            written.blobs.append(blobs.from_array(_values(layer, j), _gradient(layer, j) if diff else None))
    return proto


# Binary


def _from_message(net: Net, message: Any, path: str, file: BinaryIO | None, report: Report) -> Copies:
    targets = net.layers_by_name()
    copies: Copies = []
    for source in message.layer:
        target = targets.get(source.name)
        if target is None:
            _ignore(source.name)
            continue
        if len(source.blobs) != len(target.blobs):
            report(_wrong_count(path, source.name, len(source.blobs), len(target.blobs)))
            continue
        for j, blob in enumerate(source.blobs):
            if not (blobs.fits(blob, target.blob_shapes[j]) or target.takes_stored(j, blobs.shape_of(blob))):
                report(_wrong_shape(path, source.name, j, blobs.shape_of(blob), target.blob_shapes[j]))
                continue
            try:
                copies.append((target, j, blobs.in_file(blob, file) or blobs.to_array(blob)))
            except ValueError as fault:
                report(SpecError(f'layer "{source.name}", blob {j}: {fault}', Where(str(path))))
    return copies


# HDF5: /data/<layer>/<i>, and /diff/<layer>/<i>


def _from_hdf5(net: Net, path: str, report: Report) -> Copies:
    with open_hdf5(path) as file:
        data = file.group("data")
        if data is None:
            raise SpecError("this is not a weights file: the HDF5 file has no group /data")
        return _from_arrays(net, layer_groups(data), path, report)


def _from_safetensors(net: Net, path: str, report: Report) -> Copies:
    """Find the weights in a file of ``netspec export --to safetensors``, whose tensors are named LAYER.INDEX."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    layers: dict[str, dict[str, Any]] = {}
    try:
        for name, tensor in load_file(path).items():
            layer, _, number = name.rpartition(".")
            if layer and number.isdigit():
                layers.setdefault(layer, {})[number] = tensor.float().numpy()
    except (SafetensorError, OSError) as fault:
        raise SpecError(f"is a .safetensors file that cannot be read: {fault}", Where(str(path))) from None
    if not layers:
        raise SpecError("has no tensor named LAYER.NUMBER, as netspec export --to safetensors writes", Where(str(path)))
    return _from_arrays(net, layers.items(), path, report)


def _from_arrays(net: Net, layers: Iterable[tuple[str, Any]], path: str, report: Report) -> Copies:
    targets = net.layers_by_name()
    shared = _shared(net)
    copies: Copies = []
    for name, arrays in layers:
        target = targets.get(name)
        if target is None:
            _ignore(name)
            continue
        if len(arrays) > len(target.blobs):
            report(_wrong_count(path, name, len(arrays), len(target.blobs)))
            continue
        for j in range(len(target.blobs)):
            array = arrays.get(str(j))
            if array is None:
                if (name, j) in shared:
                    continue
                report(_wrong_count(path, name, len(arrays), len(target.blobs)))
                break
            if not target.takes_stored(j, array.shape):
                report(_wrong_shape(path, name, j, array.shape, target.blob_shapes[j]))
                continue
            copies.append((target, j, array[()].astype(np.float32)))
    return copies


# Net


def check_names(net: Net, path: str | Path) -> None:
    """Raise SpecError if two layers have one name, but not the same blobs: only the first would get its weights."""
    named = net.layers_by_name()
    for layer in net.layers:
        if len(layer.blobs) and [*map(id, layer.blobs)] != [*map(id, named[layer.param.name].blobs)]:
            fault = f'two layers have the name "{layer.param.name}"; rename one of them'
            raise SpecError(f"cannot be written: {fault}", Where(str(path)))


def _shared(net: Net) -> set[tuple[str, int]]:
    """Return the blobs, as (layer, index), that an earlier layer owns."""
    owners: dict[int, tuple[str, int]] = {}
    places = [(blob, (layer.param.name, j)) for layer in net.layers for j, blob in enumerate(layer.blobs)]
    return {place for blob, place in places if owners.setdefault(id(blob), place) != place}


def _values(layer: Any, j: int) -> np.ndarray:
    return layer.blob(j).detach().cpu().numpy()


def _gradient(layer: Any, j: int) -> np.ndarray:
    gradient = layer.blobs[j].grad
    if gradient is None:
        return np.zeros(layer.blob_shapes[j], np.float32)
    return gradient.detach().cpu().numpy().reshape(layer.blob_shapes[j])


# Messages


def _ignore(name: str) -> None:
    log.info("net.cpp:746", f"Ignoring source layer {name}")


def _wrong_count(path: str, name: str, found: int, expected: int) -> SpecError:
    message = f"incompatible number of blobs for layer '{name}': {found} in the file, {expected} in the net. "
    return SpecError(message + _RENAME, Where(str(path)))


def _wrong_shape(path: str, name: str, j: int, found: tuple[int, ...], expected: tuple[int, ...]) -> SpecError:
    shapes = f"Source param shape is {shape_string(found)}; target param shape is {shape_string(expected)}."
    message = f"cannot copy param {j} weights from layer '{name}'; shape mismatch. {shapes} {_RENAME}"
    return SpecError(message, Where(str(path)))


_RENAME = "To learn this layer's parameters from scratch rather than copying from a saved net, rename the layer."
