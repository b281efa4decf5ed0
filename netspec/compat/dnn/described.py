"""What a net tells of itself without running: its layers, their shapes and costs, and what it does not do.

OpenCV: modules/dnn/src/net_impl.cpp (4.12)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from netspec.compat.dnn.caffe_files import CaffeFiles
from netspec.compat.dnn.costs import operations
from netspec.compat.dnn.errors import BAD_ARGUMENT, NOT_FOUND, NOT_IMPLEMENTED, UNSPECIFIED, DnnError, as_dnn_error
from netspec.compat.dnn.table import INPUT, Entry, graph_of, make_table, nodes_of, unconnected
from netspec.errors import Where, did_you_mean
from netspec.files.whole_file import write_whole
from netspec.layers.contract.base import Layer as CaffeLayer
from netspec.layers.contract.base import Shape
from netspec.net.net import Net as CaffeNet

Array = np.ndarray
Shapes = list[Shape]
AS_WRITTEN = "{} cannot change a net of Caffe's files; write the layer into the prototxt"


def _refused(func: str, message: str, code: int = NOT_IMPLEMENTED) -> Callable[..., NoReturn]:
    """Return a method that refuses, whatever it gets."""

    def refuse(self: Described, *arguments: Any, **named: Any) -> NoReturn:
        raise DnnError(message.format(func), self._file(), code, func)

    return refuse


class Described:
    """The layers of Caffe's files, under OpenCV's names and numbers; without files there are none."""

    def __init__(self, files: CaffeFiles | None = None) -> None:
        self._files = files
        self._table: list[Entry] = make_table(files.net) if files else []
        self._numbers = {entry.name: number for number, entry in enumerate(self._table)}
        self._declared: dict[str, Shape | None] = files.inputs if files else {}
        self._shown = {blob: blob for blob in self._declared}  # names of inputs, as setInputsNames may change them
        self._values: dict[str, Array] = {}
        self._of_shapes: tuple[dict[str, Shape], CaffeNet] | None = None
        if files is not None and None not in self._declared.values():
            with as_dnn_error("readNetFromCaffe"):
                _ = self._net

    # Its layers

    def empty(self) -> bool:
        """Return whether it has no layers."""
        return len(self._table) < 2

    def getLayerNames(self) -> tuple[str, ...]:
        """Return the names of all layers but the input layer."""
        return tuple(entry.name for entry in self._table[1:])

    def getLayerId(self, layer: str) -> int:
        """Return the number of a layer, -1 where there is none of that name."""
        return self._numbers.get(layer, -1)

    def getLayerTypes(self) -> tuple[str, ...]:
        """Return the types of its layers, each once, in alphabetical order."""
        return tuple(sorted({entry.type or "__NetInputLayer__" for entry in self._table}))

    def getLayersCount(self, layerType: str) -> int:
        """Return how many layers are of a type."""
        return sum((entry.type or "__NetInputLayer__") == layerType for entry in self._table)

    def getUnconnectedOutLayers(self) -> Array:
        """Return the numbers of the layers whose tops no layer reads: (n,) int32."""
        return np.array(unconnected(self._files.net, self._table) if self._files else [], np.int32)

    def getUnconnectedOutLayersNames(self) -> tuple[str, ...]:
        """Return the names of the layers whose tops no layer reads."""
        return tuple(self._table[number].name for number in self.getUnconnectedOutLayers())

    def dump(self) -> str:
        """Return the layers, with the shapes of their tops, and what they read, in Graphviz's language."""
        self._check_not_empty("dump")
        assert self._files is not None
        given = {key: value.shape for key, value in self._values.items()}
        with as_dnn_error("dump"):
            net = self._files.build(given, "meta")
        return graph_of(self._files.net, self._table, [self._shapes(net, entry)[1] for entry in self._table])

    def dumpToFile(self, path: str) -> None:
        """Write :meth:`dump` to a file."""
        with as_dnn_error("dumpToFile"):
            write_whole(path, self.dump())

    # Shapes and costs

    def getLayersShapes(self, netInputShapes: Any) -> tuple[Array, tuple[Any, ...], tuple[Any, ...]]:
        """Return the numbers of all layers and the shapes of their bottoms and tops, for inputs of these shapes."""
        net = self._shaped(netInputShapes, "getLayersShapes")
        shapes = [self._shapes(net, entry) for entry in self._table]
        ids = np.arange(len(self._table), dtype=np.int32)
        return ids, tuple(_arrays(ins) for ins, _ in shapes), tuple(_arrays(outs) for _, outs in shapes)

    def getLayerShapes(self, netInputShape: Any, layerId: int | str) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Return the shapes of the bottoms and of the tops of one layer."""
        net = self._shaped(netInputShape, "getLayerShapes")
        bottoms, tops = self._shapes(net, self._entry(layerId, "getLayerShapes"))
        return _arrays(bottoms), _arrays(tops)

    def getFLOPS(self, *arguments: Any, **named: Any) -> int:
        """Return the operations of a pass: ``getFLOPS(shapes)``, or of one layer: ``getFLOPS(number, shapes)``."""
        net, entries = self._asked("getFLOPS", arguments, named)
        return sum(self._operations(net, entry) for entry in entries)

    def getMemoryConsumption(self, *arguments: Any, **named: Any) -> tuple[int, int]:
        """Return bytes of weights and of tops, of all layers or of one; arguments as :meth:`getFLOPS`."""
        net, entries = self._asked("getMemoryConsumption", arguments, named)
        owners = [entry for entry in entries if entry.name != INPUT and entry.top <= 0]
        weights = sum(blob.numel() for entry in owners for blob in self._layer(net, entry).blobs)
        return 4 * weights, 4 * sum(math.prod(shape) for entry in entries for shape in self._shapes(net, entry)[1])

    def _asked(self, func: str, arguments: Sequence[Any], named: Mapping[str, Any]) -> tuple[CaffeNet, list[Entry]]:
        shapes = named.get("netInputShapes", named.get("netInputShape", arguments[-1] if arguments else None))
        layer = named.get("layerId", arguments[0] if len(arguments) > 1 else None)
        return self._shaped(shapes, func), self._table if layer is None else [self._entry(layer, func)]

    def _shaped(self, given: Any, func: str) -> CaffeNet:
        """Return the net built without values for inputs of these shapes: one shape, or one for each input."""
        self._check_not_empty(func)
        assert self._files is not None
        rows = [given] if len(given) and np.isscalar(given[0]) else given
        if len(rows) > len(self._declared):
            message = f"found {len(rows)} shapes, expected {len(self._declared)}: {', '.join(self._shown.values())}"
            raise DnnError(message, code=BAD_ARGUMENT, func=func)
        shapes = {key: tuple(int(n) for n in row) for key, row in zip(self._declared, rows, strict=False)}
        if self._of_shapes is None or self._of_shapes[0] != shapes:
            with as_dnn_error(func):
                self._of_shapes = shapes, self._files.build(shapes, "meta")
        return self._of_shapes[1]

    def _shapes(self, net: CaffeNet, entry: Entry) -> tuple[Shapes, Shapes]:
        if entry.name == INPUT:
            inputs = [shape for layer in net.layers if layer.is_input for shape in layer.top_shapes]
            return inputs, inputs
        layer = self._layer(net, entry)
        if layer.type == "Axpy":
            a, x, y = layer.bottom_shapes
            return ([x, a] if entry.top < 0 else [x, y]), [x]
        if entry.type == "Convolution":
            return [layer.bottom_shapes[entry.top]], [layer.top_shapes[entry.top]]
        return layer.bottom_shapes, layer.top_shapes

    def _operations(self, net: CaffeNet, entry: Entry) -> int:
        if entry.name == INPUT or entry.top > 0:
            return 0
        layer = self._layer(net, entry)
        if layer.type == "Axpy":
            return (2 if entry.top < 0 else 1) * sum(math.prod(shape) for shape in self._shapes(net, entry)[0])
        return operations(layer)

    # What changes nothing, and what it refuses

    def _accept(self, *settings: Any, **named: Any) -> None:
        """Accept a setting: there is one backend, torch, nets run on the CPU, and no switch changes a result."""

    setPreferableBackend = setPreferableTarget = enableFusion = enableWinograd = setHalideScheduler = _accept

    addLayer = _refused("addLayer", AS_WRITTEN)
    addLayerToPrev = _refused("addLayerToPrev", AS_WRITTEN)
    connect = _refused("connect", AS_WRITTEN)
    registerOutput = _refused("registerOutput", AS_WRITTEN)
    quantize = _refused(
        "quantize",
        "nets of Caffe's files are not quantized here; export the net to ONNX (netspec export) and quantize that",
    )
    forwardAsync = _refused("forwardAsync", "forwardAsync needs a backend that is not here; use forward")
    getInputDetails = _refused("getInputDetails", "the net is not quantized", UNSPECIFIED)
    getOutputDetails = _refused("getOutputDetails", "the net is not quantized", UNSPECIFIED)

    # The net behind it

    @cached_property
    def _net(self) -> CaffeNet:
        """The net, built when it is first needed: inputs without a shape in the prototxt get theirs from setInput."""
        assert self._files is not None
        given = {key: value.shape for key, value in self._values.items() if self._declared[key] is None}
        return self._files.build(given)

    @cached_property
    def _nodes(self) -> list[int]:
        assert self._files is not None
        return nodes_of(self._net.plan, self._files.net)

    def _node(self, net: CaffeNet, entry: Entry) -> Any:
        return net.plan.nodes[self._nodes[entry.layer]]

    def _layer(self, net: CaffeNet, entry: Entry) -> CaffeLayer:
        return net.layers[self._nodes[entry.layer]]

    def _entry(self, layer: int | str, func: str) -> Entry:
        number = self._numbers.get(layer, -1) if isinstance(layer, str) else int(layer)
        if 0 <= number < len(self._table):
            return self._table[number]
        if isinstance(layer, str):
            names = list(self._numbers)
            message = (
                f'no layer "{layer}" in this net{did_you_mean(layer, names) or ";"} it has: {", ".join(names[1:])}'
            )
        else:
            message = f"no layer of number {layer} in this net; it has 0 to {len(self._table) - 1}"
        raise DnnError(message, self._file(), NOT_FOUND, func)

    def _check_not_empty(self, func: str) -> None:
        if self.empty():
            raise DnnError("the net is empty", code=BAD_ARGUMENT, func=func)

    def _file(self) -> Where | None:
        return Where(self._files.source.file) if self._files else None


def _arrays(shapes: Iterable[Shape]) -> tuple[Array, ...]:
    return tuple(np.array(shape, np.int32) for shape in shapes)
