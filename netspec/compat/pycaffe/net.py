"""``caffe.Net``.

Caffe: python/caffe/_caffe.cpp, python/caffe/pycaffe.py
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from netspec import log
from netspec.compat.alias import AliasFinder
from netspec.compat.pycaffe import mode
from netspec.compat.pycaffe.errors import unwrapped_errors
from netspec.compat.pycaffe.named import Named
from netspec.compat.pycaffe.proto import caffe_pb2
from netspec.compat.pycaffe.runner import BlobRunner
from netspec.errors import did_you_mean, several
from netspec.graph.filter import with_state
from netspec.layers.data.memory import MemoryData
from netspec.layers.utility import pycaffe_shim
from netspec.layers.utility.live_blobs import Blob, BlobVec
from netspec.net import net as core
from netspec.net.build import build_net
from netspec.net.weights import load_weights, write_binary, write_hdf5
from netspec.proto.schema import PhaseValue
from netspec.proto.text import parse_net

_PACKAGE = __name__.rpartition(".")[0]
pycaffe_shim.offer(_PACKAGE, AliasFinder("caffe", _PACKAGE))  # Python layers may import all of it as caffe

FilePath = str | bytes | Path
Arrays = dict[str, np.ndarray]


class Layer(pycaffe_shim.Layer):
    """The type and the learnable blobs of a layer. For a Python layer, the user's own object is shown instead."""

    def __init__(self, type_name: str, blobs: BlobVec) -> None:
        self._type, self._blobs = type_name, blobs

    type = property(lambda self: self._type)
    blobs = property(lambda self: self._blobs)


def _hook_adder(which: str) -> Callable[[Net, Callable[[int], object]], None]:
    """Return a method that adds a function, to be called with each layer's number before or after it ran."""

    def add(self: Net, hook: Callable[[int], object]) -> None:
        self.runner.hooks[which].append(hook)

    return add


class Net:
    """A net and its blobs in memory.

    ``Net(file, phase, level=0, stages=None, weights=None)`` builds the net of a prototxt for a phase (TRAIN or TEST),
    ``Net(file, weights, phase)`` is the older form. The prototxt may use dialects. Raises
    RuntimeError for a missing file, SpecError (a ValueError) for every other fault of the files, and any exception of
    the code of a Python layer.

    ``blobs`` maps names to blobs, ``params`` layer names to learnable blobs, both in the order of the layers. The
    arrays ``data`` and ``diff`` of a blob are its memory: what is written to them counts in the next pass.
    """

    def __init__(
        self,
        network_file: FilePath,
        phase: int | FilePath,
        level: int | None = None,
        stages: Iterable[str] | None = None,
        weights: FilePath | None = None,
    ) -> None:
        if isinstance(phase, (str, bytes, Path)):
            phase, weights, level = _older_form(network_file, phase, level)
        if isinstance(level, (str, bytes, Path)):
            message = f"level is an integer, found {str(level)!r}; name the weights: Net(file, phase, weights=...)"
            raise TypeError(message)
        network_file = file_of(network_file)
        weights = None if weights is None else file_of(weights)
        with unwrapped_errors():
            net, source = parse_net(network_file)
            net = with_state(net, PhaseValue(phase), level or 0, stages or ())
            self._set_net(build_net(net, source, mode.build_options()))
        if weights is not None:
            self.copy_from(weights)

    @classmethod
    def of(cls, net: core.Net) -> Net:
        """Return a Net for one of netspec's nets, such as a solver has."""
        made = cls.__new__(cls)
        made._set_net(net)
        return made

    def _set_net(self, net: core.Net) -> None:
        mode.follow_seed(net.random)
        caffe_pb2._of_net = net.options.dialects
        self.runner = runner = BlobRunner(net)
        names = [node.name for node in net.plan.nodes]
        self._layer_names = names
        self._blob_names = list(runner.names)
        self._blob_names_index = {name: i for i, name in enumerate(runner.names)}
        self._blobs = list(runner.blobs)
        self._blobs_dict: Named[Blob] = Named("blob", zip(runner.names, runner.blobs, strict=True))
        params = [step.params for step in runner.steps]
        self.layers: list[Any] = [
            getattr(layer, "code", None) or Layer(layer.type, blobs)
            for layer, blobs in zip(net.layers, params, strict=True)
        ]
        self._layer_dict: Named[Any] = Named("layer", zip(names, self.layers, strict=True))
        self._params_dict: Named[BlobVec] = Named(
            "layer with parameters", ((name, blobs) for name, blobs in zip(names, params, strict=True) if blobs)
        )
        self._top_names = self._names_of([step.top_ids for step in runner.steps])
        self._bottom_names = self._names_of([step.bottom_ids for step in runner.steps])
        self._input_list, self._output_list = list(net.inputs), list(net.outputs)
        self._inputs = [self._blob_names.index(name) for name in net.inputs]
        self._outputs = [self._blob_names.index(name) for name in net.outputs]
        weights = {
            b: w
            for step, row in zip(runner.steps, net.loss_weights, strict=True)
            for b, w in zip(step.top_ids, row, strict=True)
        }
        self._blob_loss_weights = [weights[b] for b in range(len(self._blobs))]

    def _names_of(self, ids: Sequence[Sequence[int]]) -> Named[list[str]]:
        names = [[self._blob_names[b] for b in row] for row in ids]
        return Named("layer", zip(self._layer_names, names, strict=True))

    # Properties as Caffe's are: programs look for them on the class.

    @property
    def blobs(self) -> Named[Blob]:
        """Blob name -> blob."""
        return self._blobs_dict

    @property
    def params(self) -> Named[BlobVec]:
        """Layer name -> its learnable blobs; without the layers that have none."""
        return self._params_dict

    @property
    def layer_dict(self) -> Named[Any]:
        """Layer name -> layer."""
        return self._layer_dict

    @property
    def top_names(self) -> Named[list[str]]:
        """Layer name -> the names of its tops."""
        return self._top_names

    @property
    def bottom_names(self) -> Named[list[str]]:
        """Layer name -> the names of its bottoms."""
        return self._bottom_names

    @property
    def inputs(self) -> list[str]:
        """The names of the blobs that no layer makes."""
        return self._input_list

    @property
    def outputs(self) -> list[str]:
        """The names of the blobs that no layer reads."""
        return self._output_list

    @property
    def blob_loss_weights(self) -> Named[float]:
        """Blob name -> its weight in the loss, 0 for most."""
        return Named("blob", zip(self._blob_names, self._blob_loss_weights, strict=True))

    def _top_ids(self, layer: int) -> list[int]:
        return list(self.runner.steps[layer].top_ids)

    def _bottom_ids(self, layer: int) -> list[int]:
        return list(self.runner.steps[layer].bottom_ids)

    # Running

    def forward(self, blobs: Sequence[str] | None = None, start: Any = None, end: Any = None, **inputs: Any) -> Arrays:
        """Run the layers from ``start`` to ``end`` (names, both included; default all).

        ``inputs`` are written to the input blobs first: all of them or none. Returns the data of the net's outputs, or
        of the tops of ``end``, and of ``blobs``: views that the next pass changes.
        """
        first = 0 if start is None else self._index(start)
        last = len(self.layers) - 1 if end is None else self._index(end)
        wanted = [*(self.outputs if end is None else self.top_names[end]), *several(blobs)]
        with self.runner.used():
            self._fill(inputs, self.inputs, "data", "Input blob arguments do not match net inputs.")
            self._forward(first, last)
            return {name: self.blobs[name].data for name in dict.fromkeys(wanted)}

    def backward(self, diffs: Sequence[str] | None = None, start: Any = None, end: Any = None, **tops: Any) -> Arrays:
        """Run the layers' backward passes from ``start`` down to ``end`` (names, both included; default all).

        ``tops`` are written to the diffs of the output blobs first: all of them or none. Returns the diffs of the net's
        inputs, or of the bottoms of ``end``, and of the blobs ``diffs``.
        """
        first = len(self.layers) - 1 if start is None else self._index(start)
        last = 0 if end is None else self._index(end)
        wanted = [*(self.inputs if end is None else self.bottom_names[end]), *several(diffs)]
        with self.runner.used(forward=False):
            self._fill(tops, self.outputs, "diff", "Top diff arguments do not match net outputs.")
            self._backward(first, last)
            return {name: self.blobs[name].diff for name in dict.fromkeys(wanted)}

    def forward_simple(self) -> None:
        """Run all layers; as Dosovitskiy's fork has it."""
        self._forward(0, len(self.layers) - 1)

    def backward_simple(self) -> None:
        """Run all layers' backward passes; as Dosovitskiy's fork has it."""
        self._backward(len(self.layers) - 1, 0)

    def _forward(self, start: int, end: int) -> float:
        with self.runner.used(), unwrapped_errors():
            return self.runner.forward(start, end).item()

    def _backward(self, start: int, end: int) -> None:
        with self.runner.used(forward=False):
            self.runner.backward(start, end)

    def _index(self, layer: str) -> int:
        if layer not in self.layer_dict:
            known = ", ".join(self._layer_names)
            hint = did_you_mean(layer, self._layer_names) or ";"
            raise ValueError(f'no layer "{layer}" in this net{hint} it has: {known}')
        return self._layer_names.index(layer)

    def _fill(self, given: Mapping[str, Any], names: Sequence[str], field: str, refusal: str) -> None:
        """Write arrays that were given by keyword; refuse others than those of all ``names``."""
        if given and set(given) != set(names):
            raise ValueError(f"{refusal} Found {', '.join(given)}, expected {', '.join(names) or 'none'}")
        for name, array in given.items():
            here, there = self.blobs[name].shape, np.shape(array)
            if there[:1] != here[:1]:
                what = "Input" if field == "data" else "Diff"
                raise ValueError(f'{what} is not batch sized: found shape {there}, blob "{name}" has shape {here}')
            getattr(self.blobs[name], field)[...] = array

    def forward_all(self, blobs: Sequence[str] | None = None, **inputs: Any) -> Arrays:
        """Run :meth:`forward` on any number of items, in batches; the last one is filled up with zeros.

        Returns the data of the outputs and of ``blobs`` for all items, as new arrays.
        """
        found: dict[str, list[np.ndarray]] = {name: [] for name in dict.fromkeys([*self.outputs, *several(blobs)])}
        for batch in self._batch(inputs):
            for name, array in self.forward(blobs, **batch).items():
                found[name].extend(array.copy())
        return _without_padding(found, inputs)

    def forward_backward_all(
        self, blobs: Sequence[str] | None = None, diffs: Sequence[str] | None = None, **arrays: Any
    ) -> tuple[Arrays, Arrays]:
        """Run :meth:`forward` and :meth:`backward` on any number of items, in batches.

        ``arrays`` are inputs and diffs of outputs. Returns the data of the outputs and of ``blobs``, and the diffs of
        the inputs and of ``diffs``, for all items, as new arrays.
        """
        data: dict[str, list[np.ndarray]] = {name: [] for name in dict.fromkeys([*self.outputs, *several(blobs)])}
        grads: dict[str, list[np.ndarray]] = {name: [] for name in dict.fromkeys([*self.inputs, *several(diffs)])}
        inputs = {name: array for name, array in arrays.items() if name in self.inputs}
        tops = {name: array for name, array in arrays.items() if name not in self.inputs}
        for ahead, back in zip_longest(self._batch(inputs), self._batch(tops), fillvalue={}):
            for found, made in ((data, self.forward(blobs, **ahead)), (grads, self.backward(diffs, **back))):
                for name, array in made.items():
                    found[name].extend(array.copy())
        return _without_padding(data, arrays), _without_padding(grads, arrays)

    def _batch(self, arrays: Mapping[str, Any]) -> Iterator[Arrays]:
        """Yield the arrays batch by batch."""
        if not arrays:
            return
        for name in {"start", "end"} & arrays.keys() - self.blobs.keys():
            raise ValueError(f"all layers run in batches, so {name} cannot be given; use forward({name}=...)")
        given = {name: np.asarray(array) for name, array in arrays.items()}
        first = next(iter(given))
        size, count = self.blobs[first].num, len(given[first])
        for begin in range(0, count, size):
            batch = {name: array[begin : begin + size] for name, array in given.items()}
            lacking = begin + size - count
            if lacking > 0:
                batch = {
                    name: np.concatenate([rows, np.zeros((lacking, *rows.shape[1:]), rows.dtype)])
                    for name, rows in batch.items()
                }
            yield batch

    def reshape(self) -> None:
        """Give every blob the shape that follows from those of the inputs."""
        with unwrapped_errors():
            self.runner.reshape()

    def clear_param_diffs(self) -> None:
        """Set the gradients of the learnable blobs to 0; :meth:`backward` adds to them."""
        self.runner.clear_param_diffs()

    before_forward, after_forward = _hook_adder("before_forward"), _hook_adder("after_forward")
    before_backward, after_backward = _hook_adder("before_backward"), _hook_adder("after_backward")

    # Data and weights

    def set_input_arrays(self, data: np.ndarray, labels: np.ndarray) -> None:
        """Give the net's first layer, a MemoryData, images (n, C, H, W) and labels (n,), both float32."""
        layer = self.runner.net.layers[0]
        if not isinstance(layer, MemoryData):
            kind = f'it is "{self._layer_names[0]}" ({layer.type})'
            raise RuntimeError(f"set_input_arrays may only be called if the first layer is a MemoryDataLayer; {kind}")
        self.runner.net.positions.go_back()
        layer.set_input_arrays(data, labels)

    _set_input_arrays = set_input_arrays  # the name in Caffe's compiled part

    def copy_from(self, weights: FilePath) -> None:
        """Copy the weights of a .caffemodel, binary or HDF5, into the layers of the same names."""
        weights = file_of(weights)
        self.runner.upload()
        with unwrapped_errors():
            load_weights(self.runner.net, weights)

    def load_hdf5(self, weights: FilePath) -> None:
        """Copy the weights of an HDF5 file into the layers of the same names."""
        self.copy_from(weights)

    def share_with(self, other: Net) -> None:
        """Use the learnable blobs of another net, layer by layer of equal name."""
        self.runner.share_with(other.runner)

    def save(self, path: FilePath) -> None:
        """Write the layers and their weights in binary form, whatever the file's name ends with."""
        self.runner.upload()
        write_binary(self.runner.net, os.fsdecode(path))

    def save_hdf5(self, path: FilePath, write_diff: bool = False) -> None:
        """Write the weights as HDF5; with ``write_diff`` their gradients too."""
        self.runner.upload()
        write_hdf5(self.runner.net, os.fsdecode(path), write_diff)

    # Of 2014, when phase and mode were a net's

    def set_phase_test(self) -> None:
        """Do nothing: a net is built for a phase."""

    set_mode_cpu = staticmethod(mode.set_mode_cpu)
    set_mode_gpu = staticmethod(mode.set_mode_gpu)
    set_device = staticmethod(mode.set_device)


def file_of(path: FilePath) -> str:
    """Return the path of a file as text; Caffe takes bytes too. Raises RuntimeError where there is no such file."""
    text = os.fsdecode(path)
    if not os.path.isfile(text):
        raise RuntimeError(f"Could not open file {text}")
    return text


def _older_form(network_file: FilePath, weights: FilePath, phase: int | None) -> tuple[int, FilePath, int]:
    """Return phase, weights and level of ``Net(file, weights, phase)``."""
    phase = pycaffe_shim.TEST if phase is None else phase
    log.warning("_caffe.cpp:154", "DEPRECATION WARNING - deprecated use of Python interface")
    log.warning("_caffe.cpp:155", 'Use this instead (with the named "weights" parameter):')
    named = os.fsdecode(network_file), os.fsdecode(weights)
    log.warning("_caffe.cpp:156", f"Net('{named[0]}', {phase}, weights='{named[1]}')")
    return phase, weights, 0


def _without_padding(found: Mapping[str, list[np.ndarray]], given: Mapping[str, Any]) -> Arrays:
    """Return whole arrays, without the items that filled up the last batch."""
    if not given:
        raise ValueError("no arrays were given to run the net on")
    padding = len(next(iter(found.values()), [])) - len(next(iter(given.values())))
    return {name: np.asarray(rows)[: -padding or None] for name, rows in found.items()}
