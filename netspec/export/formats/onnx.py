"""``--to onnx``: writes a net as an ONNX model, layer by layer.

Caffe: the model corresponds to Net::Reshape for the sizes at run time
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from netspec.errors import SpecError
from netspec.export.exporter import exported, layer_notes, refusal
from netspec.export.formats.preprocess import Preprocess
from netspec.export.formats.shapes import LayerShapes, NetShapes, is_given, settled
from netspec.files.whole_file import whole_file, write_whole
from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import values_of
from netspec.net.net import Net

OPSET, IR_VERSION = 17, 8  # ONNX 1.12 (2022); older readers know it, and onnx2torch nothing newer
LARGEST = 2**31 - 2**24  # bytes of weights: protobuf's limit, with room for the graph
LARGE, PAGE = (
    1024,
    4096,
)  # bytes: smaller weights stay in the model; others are aligned to pages, for memory mapping
DTYPES = {np.dtype(np.float32): 1, np.dtype(np.uint8): 2, np.dtype(np.int64): 7, np.dtype(bool): 9}  # TensorProto's
CAST_TO = {"float32": 1, "int64": 7, "bool": 9}


def _onnx() -> Any:
    try:
        import onnx
    except ImportError:
        raise SpecError("--to onnx needs the onnx library: pip install 'netspec-caffe[onnx]'") from None
    return onnx


def export_onnx(
    net: Net,
    path: str | Path,
    metadata: Mapping[str, str] | None = None,
    preprocess: Preprocess | None = None,
    largest: int = LARGEST,
    blobs: Collection[str] = (),
) -> list[str]:
    """Write a net with its current weights as an ONNX model; return notes for the user, as lines.

    ``blobs`` that are neither inputs nor outputs become additional outputs.
    Weights of more than ``largest`` bytes are in a file next to it: ``path`` with ``.data`` appended.
    Raises SpecError if a layer cannot be exported or the file cannot be written.
    """
    _onnx()
    writer, shapes = settled(net, lambda shapes: _Writer(net, shapes, preprocess, blobs))
    notes = [*shapes.fixed, *layer_notes(net.layers)]
    path = Path(path)
    if sum(array.nbytes for array in writer.initializers.values()) <= largest:
        write_whole(path, writer.model(metadata or {}).SerializeToString())
        return notes
    data = path.with_name(f"{path.name}.data")
    with whole_file(path) as unfinished, whole_file(data) as unfinished_data:
        with unfinished_data.open("wb") as file:
            model = writer.model(metadata or {}, _DataFile(file, data.name))
        unfinished.write_bytes(model.SerializeToString())
    return [*notes, f"the weights are in {data.name}, next to the model"]


def _write_layer(layer: Layer, graph: OnnxGraph, *bottoms: str) -> str | Sequence[str]:
    """Write a layer into the graph; return the values of its tops. Raises SpecError if it cannot be exported."""
    if is_given(layer):
        return [graph.input(i) for i in range(layer.num_tops)]
    write, op = exported(layer, "to_onnx"), exported(layer, "onnx_op")
    if write is not None:
        return write(graph, *bottoms)
    if op is None:
        raise refusal(layer, "ONNX")
    attributes = exported(layer, "onnx_attributes") or ()
    return graph.node(op, *bottoms, **{name: getattr(layer, name) for name in attributes})


class _DataFile:
    """The file with the large weights of a model. The model refers to it by ``name``."""

    def __init__(self, file: BinaryIO, name: str) -> None:
        self.file, self.name = file, name

    def write(self, array: np.ndarray) -> dict[str, str]:
        """Append an array; return its location in ONNX's format."""
        self.file.seek(-(-self.file.tell() // PAGE) * PAGE)
        found = {"location": self.name, "offset": str(self.file.tell()), "length": str(array.nbytes)}
        self.file.write(array.data)
        return found


class _Writer:
    """Writes the graph of a net."""

    def __init__(self, net: Net, shapes: NetShapes, preprocess: Preprocess | None, blobs: Collection[str]) -> None:
        more = {blob: v for v, blob in enumerate(net.plan.blobs) if blob in blobs}
        self.outputs = {**net.plan.outputs, **more}
        self.net, self.shapes, self.preprocess = net, shapes, preprocess
        self.nodes: list[Any] = []
        self.initializers: dict[str, np.ndarray] = {}
        self.inputs: list[Any] = []
        self.names: set[str] = set(net.plan.blobs)
        self.values: dict[int, str] = {}  # value number -> name
        self._constants: dict[bytes, str] = {}
        self._blobs: dict[tuple[int, tuple[int, ...]], str] = {}  # by address and shape
        for i, (node, layer) in enumerate(zip(net.plan.nodes, net.layers, strict=True)):
            tops = _write_layer(layer, OnnxGraph(self, i), *(self.values[v] for v in node.bottoms))
            named = (tops,) if isinstance(tops, str) else tops
            self.values.update(zip(node.tops, named, strict=False))

    # Called by layers

    def unique(self, name: str) -> str:
        """Return a new name that starts with this one."""
        found, k = name, 1
        while found in self.names:
            found, k = f"{name}_{k}", k + 1
        self.names.add(found)
        return found

    def add(self, op: str, inputs: Sequence[str], outputs: int, name: str, attributes: Mapping[str, Any]) -> list[str]:
        """Add a node; return its outputs."""
        made = [self.unique(f"{name}/{op}") for _ in range(outputs)]
        self.nodes.append(_onnx().helper.make_node(op, list(inputs), made, name=made[0], **attributes))
        return made

    def store(self, values: np.ndarray, name: str) -> str:
        """Add an initializer; return its name. Equal small ones are stored once."""
        key = f"{values.dtype} {values.shape} ".encode() + values.tobytes() if values.size <= 64 else b""
        if key and key in self._constants:
            return self._constants[key]
        unique = self.unique(name)
        self.initializers[unique] = values
        if key:
            self._constants[key] = unique
        return unique

    def store_blob(self, blob: torch.Tensor, shape: tuple[int, ...], name: str) -> str:
        """Add a learnable blob, once for all layers that share it; return its name."""
        key = (blob.data_ptr(), shape)
        if key not in self._blobs:
            self._blobs[key] = self.store(values_of(blob).cpu().float().reshape(shape).numpy(), name)
        return self._blobs[key]

    def add_input(self, value: int, blob: str) -> str:
        """Add an input of the net, with the preprocessing of images; return the value that the net reads."""
        sizes = self.symbols(value)
        if self.preprocess is None or self.preprocess.blob != blob:
            self.inputs.append(_value_info(blob, np.float32, sizes))
            return blob
        shape = self.shapes.sizes(value)
        dtype, image, read = self.preprocess.to_onnx(_Steps(self, blob), blob, shape)
        self.inputs.append(_value_info(blob, dtype, [s if i is None else i for s, i in zip(sizes, image, strict=True)]))
        return read

    def symbols(self, value: int) -> list[int | str]:
        """Return the shape of a value for ONNX: numbers, and names for dynamic sizes."""
        sizes: list[int | str] = []
        for axis, size in enumerate(self.shapes.sizes(value)):
            name = self.shapes.name(value, axis) if size is None else ""
            sizes.append(f"{self.net.plan.blobs[value]}_{axis}" if name == "?" else name if size is None else size)
        return sizes

    # The model

    def model(self, metadata: Mapping[str, str], data_file: _DataFile | None = None) -> Any:
        """Return the model. Its large weights are written to ``data_file``, if there is one."""
        onnx, net = _onnx(), self.net
        renamed = self._name_values()
        taken = {given.name for given in self.inputs}
        outputs = [
            _value_info(name, np.float32, self.symbols(v)) for name, v in self.outputs.items() if name not in taken
        ]
        used = {name for node in self.nodes for name in node.input}
        stored = [_tensor(name, array, data_file) for name, array in self.initializers.items() if name in used]
        graph = onnx.helper.make_graph(self.nodes, net.name or "net", self.inputs, outputs, stored)
        model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)])
        model.ir_version = IR_VERSION
        model.producer_name = "netspec"
        described = {**metadata, **({"blobs": json.dumps(renamed)} if renamed else {})}
        if self.shapes.fixed:
            file = net.plan.source.file  # the folder is private
            described["fixed"] = "\n".join(self.shapes.fixed).replace(file, Path(file).name)
        if self.preprocess:
            described["input"] = self.preprocess.description
        onnx.helper.set_model_props(model, {f"netspec.{key}": text for key, text in described.items()})
        return model

    def _name_values(self) -> dict[str, str]:
        """Name the values after their blobs. Return name -> description for those that need another name.

        If layers change a blob in place, its last value gets the name of the blob.
        """
        plan = self.net.plan
        layer_of = {v: node.name for node in plan.nodes for v in node.tops}
        passed_on = {
            v for node in plan.nodes for v in node.tops if self.values[v] in map(self.values.get, node.bottoms)
        }
        inputs = {info.name for info in self.inputs}
        new_names: dict[str, str] = {}
        descriptions: dict[str, str] = {}
        taken = set(inputs)
        for v in reversed(range(len(plan.blobs))):
            old, blob = self.values[v], plan.blobs[v]
            is_output = self.outputs.get(blob) == v and blob not in inputs
            if is_output and (v in passed_on or old in new_names or old in inputs or old in self.initializers):
                passed_on.discard(v)
                old = self.values[v] = self.add("Identity", [old], 1, layer_of[v], {})[0]
            if v in passed_on or old in new_names or old in inputs or old in self.initializers:
                continue
            name = blob
            if blob in taken:
                name = self.unique(f"{blob}_of_{layer_of[v]}")
                descriptions[name] = f'blob "{blob}" after layer "{layer_of[v]}"'
            taken.add(name)
            new_names[old] = name
        for node in self.nodes:
            node.input[:] = [new_names.get(name, name) for name in node.input]
            node.output[:] = [new_names.get(name, name) for name in node.output]
        return descriptions


def _tensor(name: str, array: np.ndarray, data_file: _DataFile | None) -> Any:
    onnx = _onnx()
    tensor = onnx.TensorProto(name=name, dims=array.shape, data_type=DTYPES[array.dtype])
    array = np.ascontiguousarray(array)
    if data_file is None or array.nbytes < LARGE:
        tensor.raw_data = array.tobytes()
        return tensor
    tensor.data_location = onnx.TensorProto.EXTERNAL
    for key, value in data_file.write(array).items():
        tensor.external_data.add(key=key, value=value)
    return tensor


def _value_info(name: str, dtype: Any, sizes: Sequence[int | str]) -> Any:
    return _onnx().helper.make_tensor_value_info(name, DTYPES[np.dtype(dtype)], list(sizes))


class _Steps:
    """Nodes and constants: the part of :class:`OnnxGraph` that needs no layer."""

    def __init__(self, writer: _Writer, name: str) -> None:
        self.writer, self.name = writer, name

    def node(self, op: str, *inputs: str, **attributes: Any) -> str:
        """Add a node of one output and return the output. An empty input is one that is left out."""
        return self.writer.add(op, inputs, 1, self.name, attributes)[0]

    def nodes(self, op: str, *inputs: str, outputs: int, **attributes: Any) -> tuple[str, ...]:
        """Add a node of several outputs and return them."""
        return tuple(self.writer.add(op, inputs, outputs, self.name, attributes))

    def constant(self, values: Any) -> str:
        """Return a constant: numbers, lists or arrays. Whole numbers become int64, other numbers float32."""
        array = values_of(values).cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)
        if array.dtype != bool:
            array = array.astype(np.int64 if array.dtype.kind in "iu" else np.float32)
        return self.writer.store(array, f"{self.name}/constant")

    def shape_of(self, value: str, start: int = 0, end: int | None = None) -> str:
        """Return the sizes of the axes from ``start`` to ``end`` of a value, as they are when the net runs."""
        return self.node("Shape", value, start=start, **({} if end is None else {"end": end}))

    def reshape(self, value: str, sizes: Sequence[int]) -> str:
        """Return the value in another shape; 0 copies the size of the same axis, one -1 is inferred."""
        return self.node("Reshape", value, self.constant(list(sizes)))

    def cast(self, value: str, dtype: str) -> str:
        """Return the value as ``float32``, ``int64`` or ``bool``."""
        return self.node("Cast", value, to=CAST_TO[dtype])


class OnnxGraph(_Steps, LayerShapes):
    """The ONNX graph that is being written, as one layer sees it. Values are known by name.

    Bottoms and tops are known by their index in the layer. Sizes that the caller of the exported net may choose are
    None; a layer that needs such a size as a number asks for it with :meth:`size`, which fixes it.
    """

    def __init__(self, writer: _Writer, index: int) -> None:
        self.layer: Layer = writer.net.layers[index]
        self.plan_node = writer.net.plan.nodes[index]
        self.shapes = writer.shapes
        super().__init__(writer, self.plan_node.name)

    def blob(self, index: int, shape: Sequence[int] | None = None) -> str:
        """Return a learned blob of the layer, in its own shape or in another of as many elements."""
        wanted = self.layer.blob_shapes[index] if shape is None else tuple(shape)
        return self.writer.store_blob(self.layer.blob(index), wanted, f"{self.name}.{index}")

    def input(self, top: int) -> str:
        """Return a new input of the whole net, for a top that its caller gives."""
        value = self.plan_node.tops[top]
        return self.writer.add_input(value, self.writer.net.plan.blobs[value])

    def reshape_to_top(self, value: str, top: int = 0) -> str:
        """Return the value in the shape of a top of the layer, whatever the free sizes are."""
        number = self.plan_node.tops[top] if top < len(self.plan_node.tops) else -1
        sizes = list(self.layer.top_shapes[top]) if number < 0 else list(self.shapes.sizes(number))
        free = [axis for axis, size in enumerate(sizes) if size is None]
        if len(free) <= 1:
            return self.reshape(value, [-1 if size is None else size for size in sizes])
        parts = []
        inferred = False
        for axis, size in enumerate(sizes):
            if size is not None:
                parts.append(self.constant([size]))
                continue
            found = self._like(number, axis)
            if found is None and inferred:
                raise self.fixed(number, axis, "more than one size of its shape is unknown")
            inferred = inferred or found is None
            parts.append(found or self.constant([-1]))
        return self.node("Reshape", value, self.node("Concat", *parts, axis=0))

    def _like(self, value: int, axis: int) -> str | None:
        """Return the size of an axis of a bottom that always equals this size, if there is one."""
        for bottom in self.plan_node.bottoms:
            for k in range(len(self.shapes.built[bottom])):
                if self.shapes.same((bottom, k), (value, axis)):
                    return self.shape_of(self.writer.values[bottom], k, k + 1)
        return None
