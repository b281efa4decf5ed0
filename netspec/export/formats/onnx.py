"""``--to onnx``: writes a net as an ONNX model, which torch.onnx makes from the exported PyTorch module.

Caffe: the model corresponds to Net::Reshape for the sizes at run time
"""

from __future__ import annotations

import json
import logging
import os
import signal
import threading
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from netspec.errors import SpecError
from netspec.export.exporter import layer_notes, refusal
from netspec.export.expression import TRAINING, Call, Submodule, evaluate, parts
from netspec.export.formats.nodes import translations
from netspec.export.formats.preprocess import Preprocess
from netspec.export.formats.shapes import NetShapes, settled
from netspec.export.formats.source import unique
from netspec.export.formats.torch_code import Definition, write_definition
from netspec.files.whole_file import whole_file, write_whole
from netspec.graph.options import OPSET
from netspec.net.net import Net

IR_VERSION = 8  # of ONNX 1.13
LARGEST = 2**31 - 2**24  # bytes of weights: protobuf's limit, with room for the graph
LARGE = 1024  # bytes: smaller weights stay in the model


def export_onnx(
    net: Net,
    path: str | Path,
    metadata: Mapping[str, str] | None = None,
    preprocess: Preprocess | None = None,
    largest: int = LARGEST,
    blobs: Collection[str] = (),
) -> list[str]:
    """Write a net with its current weights as an ONNX model; return notes for the user, as lines.

    ``blobs`` that are neither inputs nor outputs become additional outputs. Weights of more than ``largest`` bytes are
    in a file next to the model: ``path`` with ``.data`` appended. Raises SpecError if a layer cannot be exported or the
    file cannot be written.
    """
    for library in ("onnx", "onnxscript"):
        if find_spec(library) is None:
            raise SpecError(f"--to onnx needs the {library} library: pip install 'netspec-caffe[onnx]'")
    import onnx_ir as ir

    definition, shapes = onnx_definition(net)
    writer = _Writer(net, definition, shapes, preprocess, blobs)
    model = writer.model(dict(metadata or {}))
    notes, path = [*writer.shapes.fixed, *layer_notes(net.layers)], Path(path)
    if sum(value.const_value.nbytes for value in model.graph.initializers.values()) <= largest:
        write_whole(path, ir.to_proto(model).SerializeToString())
        return notes
    data = path.with_name(f"{path.name}.data")
    with whole_file(path) as unfinished, whole_file(data) as written:
        ir.external_data.unload_from_model(model, written.parent, written.name, size_threshold_bytes=LARGE)
        proto = ir.to_proto(model)
        for place in (each for tensor in proto.graph.initializer for each in tensor.external_data):
            place.value = data.name if place.key == "location" else place.value
        unfinished.write_bytes(proto.SerializeToString())
    return [*notes, f"the weights are in {data.name}, next to the model"]


def onnx_definition(net: Net) -> tuple[Definition, NetShapes]:
    """Return the module from which the model of a net is made, and its shapes. Raises SpecError."""
    definition, shapes = settled(net, lambda shapes: write_definition(net, shapes, onnx=True))
    for targets, expression in definition.statements:
        if any(part is TRAINING for part in parts(expression)):
            layer = next(
                layer for layer, node in zip(net.layers, net.plan.nodes, strict=True) if targets[0] in node.tops
            )
            raise refusal(layer, "it draws random numbers in the training phase; --to torch has it")
    return definition, shapes


class _Writer:
    """Makes the model of a net: torch.onnx traces its definition, whose values then get the names of their blobs."""

    def __init__(
        self,
        net: Net,
        definition: Definition,
        shapes: NetShapes,
        preprocess: Preprocess | None,
        blobs: Collection[str],
    ) -> None:
        self.net, self.definition, self.shapes, self.preprocess = net, definition, shapes, preprocess
        self.given = {net.plan.blobs[v]: v for v in definition.inputs}
        self.layer_of = {v: node.name for node in net.plan.nodes for v in node.tops}
        self.last = {blob: v for v, blob in enumerate(net.plan.blobs)}
        self.described: dict[str, str] = {}  # what the names of values that need another name stand for
        self.names = {v: self._name(v) for targets, _ in definition.statements for v in targets}
        more = {blob: self.last[blob] for blob in blobs if self.given.get(blob) != self.last[blob]}
        self.outputs = {**net.plan.outputs, **more}

    def _name(self, v: int) -> str:
        """Return the name of a value: its blob, if it is the last value of the blob, or BLOB_of_LAYER."""
        blob = self.net.plan.blobs[v]
        if self.definition.passed[self.last[blob]] == v and blob not in self.given:
            return blob
        layer = self.layer_of[v]
        name = unique(f"{blob}_of_{layer}", {*self.last, *self.described})
        self.described[name] = f'blob "{blob}" after layer "{layer}"'
        return name

    def model(self, metadata: dict[str, str]) -> Any:
        """Return the model, of onnx_ir, without its weights in the form of a file."""
        steps = None
        if self.preprocess:
            shape = self.shapes.sizes(self.given[self.preprocess.blob])
            self.preprocess.check(shape)
            steps = self.preprocess.blob, partial(self.preprocess.applied, shape)
        module = _Traced(self.definition, [*self._copied.values()], steps).eval()
        examples, free = self._examples()
        sizes = (tuple(free),) if free else None
        with _signals_kept(), _quiet(), torch.no_grad():
            traced = torch.export.export(module, (tuple(examples),), dynamic_shapes=sizes, strict=False)
            options = {"opset_version": OPSET, "custom_translation_table": translations()}
            program: Any = torch.onnx.export(traced, dynamo=True, optimize=False, verbose=False, **options)
            self._set_ends(program.model.graph)
            _simplify(program.model)
        model = program.model
        model.graph.outputs.extend(x for x in model.graph.inputs if x.name in self.outputs.keys() & self.given.keys())
        _pad_pixels(model.graph)
        self._name_all(model.graph)
        if self.described:
            metadata["blobs"] = json.dumps(self.described)
        if self.shapes.fixed:
            file = self.net.plan.source.file  # the folder is private
            metadata["fixed"] = "\n".join(self.shapes.fixed).replace(file, Path(file).name)
        if self.preprocess:
            metadata["input"] = self.preprocess.description
        model.ir_version, model.producer_name, model.producer_version = IR_VERSION, "netspec", ""
        model.metadata_props.clear()
        model.metadata_props.update({f"netspec.{key}": text for key, text in metadata.items()})
        return model

    @cached_property
    def _copied(self) -> dict[str, int]:
        """The outputs that are copies: those that are inputs or parameters, or other names of a value."""
        calls = {v for targets, it in self.definition.statements if isinstance(it, Call) for v in targets}
        ends = {name: v for name, v in self.outputs.items() if self.given.get(name) != v}
        sources = {name: self.definition.passed[v] for name, v in ends.items()}
        return {name: v for name, v in sources.items() if v not in calls or self._output_name(name) != self.names[v]}

    def _output_name(self, blob: str) -> str:
        return self.names.get(self.last[blob], blob) if blob in self.given else blob

    def _sizes(self, v: int) -> list[int | str]:
        """Return the shape of a value: numbers, and names for dynamic sizes."""
        names = [self.shapes.name(v, axis) for axis in range(len(self.shapes.built[v]))]
        unknown = f"{self.net.plan.blobs[v]}_"
        sizes = zip(self.shapes.sizes(v), names, strict=True)
        return [
            size if size is not None else f"{unknown}{axis}" if name == "?" else name
            for axis, (size, name) in enumerate(sizes)
        ]

    def _examples(self) -> tuple[list[torch.Tensor], list[dict[int, Any]]]:
        """Return an input of each size that is traced, and its dynamic axes. Torch takes a size of 1 for a constant."""
        examples, every = [], []
        for v in self.definition.inputs:
            sizes, free, dtype = list(self.shapes.built[v]), {}, torch.float32
            for each in self.shapes.free:
                for axis in (axis for value, axis in each.axes if value == v and not each.counted):
                    free[axis] = torch.export.Dim.AUTO
                    sizes[axis] = sizes[axis] if sizes[axis] > 1 else each.tried[0][v][axis]
            if self.preprocess and self.preprocess.blob == self.net.plan.blobs[v]:
                dtype = torch.uint8 if self.preprocess.uint8 else dtype
                for axis in (2, 3) if self.preprocess.crop else ():
                    free[axis], sizes[axis] = torch.export.Dim.AUTO, sizes[axis] + 2
            examples.append(torch.zeros(sizes, dtype=dtype))
            every.append(free)
        return examples, every

    def _set_ends(self, graph: Any) -> None:
        """Name the inputs, the outputs and the values of blobs, and describe their sizes."""
        import onnx_ir as ir

        for value, v in zip(graph.inputs, self.definition.inputs, strict=True):
            found = value.shape
            for each in self.shapes.free:
                for axis in (axis for own, axis in each.axes if own == v and not each.counted):
                    if isinstance(found[axis], int):
                        self.shapes = self.shapes.without(each, "torch.export takes it for a constant")
            sizes = self._sizes(v)
            if self.preprocess and self.preprocess.crop and self.preprocess.blob == self.net.plan.blobs[v]:
                sizes[2:] = ["image_H", "image_W"]
            value.name, value.shape = self.net.plan.blobs[v], ir.Shape(sizes)
        made = [*self.names.values(), *map(self._output_name, self._copied)]
        by_name = dict(zip(made, graph.outputs, strict=True))
        for k, value in enumerate(value for node in graph for value in node.outputs):
            value.name = f"value/{k}"
        for name, value in by_name.items():
            value.name = name
        taken = {*self.last, *self.described, *graph.initializers}
        for value in [graph.initializers[name] for name in graph.initializers if name in self.last]:
            value.name = unique(value.name, taken)
        graph.outputs.clear()
        for blob, v in self.outputs.items():
            if self.given.get(blob) == v:
                continue
            value = by_name[self._output_name(blob)]
            value.shape = ir.Shape(self._sizes(v))
            graph.outputs.append(value)

    def _name_all(self, graph: Any) -> None:
        """Name nodes after what they compute, and remove what torch wrote of files and sizes."""
        import onnx_ir as ir

        ends = {id(value) for value in (*graph.inputs, *graph.outputs)}
        taken = {*self.last, *self.described}
        graph.name, graph.doc_string = self.net.name or "net", None
        graph.metadata_props.clear()
        for value in (*graph.inputs, *graph.initializers.values()):
            value.metadata_props.clear()
        pending: list[Any] = []
        for node in graph:
            node.metadata_props.clear()
            node.doc_string = None
            if node.op_type == "ConstantOfShape" and "value" not in node.attributes:  # OpenCV 5 has no default
                node.attributes["value"] = ir.AttrTensor("value", ir.tensor(np.zeros(1, np.float32)))
            pending.append(node)
            named = next((value.name for value in node.outputs if value.name in taken), "")
            for each in pending if named else ():
                each.name = unique(f"{named}/{each.op_type}", taken)
            pending = [] if named else pending
            for value in node.outputs:
                value.metadata_props.clear()
                if id(value) not in ends:
                    value.shape = None


def _simplify(model: Any) -> None:
    """Fold constants, and BatchNorm into filters; remove what has no effect.

    ``ONNXProgram.optimize`` has more rules. One takes x + 1e-9, as in MVN, for x.
    """
    from onnx_ir.passes import Sequential, common
    from onnxscript.optimizer import fold_constants_ir
    from onnxscript.rewriter import rewrite
    from onnxscript.rewriter.rules import common as rules

    fold_constants_ir(model)
    rewrite(
        model,
        [
            rules.fuse_batchnorm_into_conv_rule,
            rules.fuse_batchnorm_into_conv_transpose_rule,
            rules.fuse_batchnorm_into_gemm_rule,
            rules.no_op_cast_rule,
            rules.no_op_expand_rule,
            rules.no_op_transpose_rule,
            rules.reshape_reshape_rule,
            rules.materialize_reshape_shape_rule,
        ],
    )
    fold_constants_ir(model)
    Sequential(
        common.RemoveUnusedNodesPass(),
        common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        common.DeduplicateInitializersPass(),
        common.CommonSubexpressionEliminationPass(),
        common.OutputFixPass(),
        common.NameFixPass(),
    )(model)


def _pad_pixels(graph: Any) -> None:
    """Pad the maps for filters of one pixel in a node of its own, because OpenCV 5 pads them wrong."""
    import onnx_ir as ir

    for node in graph:
        pads = node.attributes.get_ints("pads", ())
        if node.op_type != "Conv" or not any(pads) or set(node.attributes.get_ints("kernel_shape", (0,))) != {1}:
            continue
        half = len(pads) // 2
        frame = ir.node("Constant", [], {"value_ints": [0, 0, *pads[:half], 0, 0, *pads[half:]]})
        padded = ir.node("Pad", [node.inputs[0], frame.outputs[0]])
        graph.insert_before(node, [frame, padded])
        node.replace_input_with(0, padded.outputs[0])
        node.attributes["pads"] = ir.AttrInt64s("pads", [0] * len(pads))


class _Traced(nn.Module):
    """The module that torch traces. Its outputs are all values of the definition, and copies of some.

    ``steps`` are the name of a blob and a function that prepares it.
    """

    def __init__(self, definition: Definition, copied: Sequence[int], steps: tuple[str, Any] | None) -> None:
        super().__init__()
        self.definition, self.copied, self.steps = definition, copied, steps
        with torch.device("meta"):
            for stored, name in definition.attributes.items():
                if isinstance(stored, Submodule):
                    setattr(self, name, stored.cls(*stored.args, **stored.options))
                else:
                    self.register_buffer(name, torch.zeros(stored.values.shape))
        # Copies, because torch keeps tensors that it has traced.
        self.load_state_dict({name: tensor.clone() for name, tensor in definition.state().items()}, assign=True)

    def forward(self, inputs: Sequence[torch.Tensor]) -> Any:
        definition = self.definition
        known: dict[Any, Any] = {each: getattr(self, name) for each, name in definition.attributes.items()}
        known[TRAINING] = False
        for v, x in zip(definition.inputs, inputs, strict=True):
            known[definition.values[v]] = self.steps[1](x) if self.steps and definition.blobs[v] == self.steps[0] else x
        values: list[Any] = []
        for targets, expression in definition.statements:
            made = evaluate(expression, known)
            made = made if len(targets) > 1 else (made,)
            known.update((definition.values[v], x) for v, x in zip(targets, made, strict=True))
            values.extend(made)
        return (*values, *(known[definition.values[v]].clone() for v in self.copied))


@contextmanager
def _quiet() -> Iterator[None]:
    """Log and warn nothing of what torch says about its own steps."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Keep Ctrl-C and SIGTERM until the block ends: an exception in a C++ destructor of torch aborts the process.

    A second signal ends the process at once.
    """
    kept: list[int] = []

    def keep(number: int, _: object) -> None:
        if kept:
            os._exit(128 + number)
        kept.append(number)

    main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, keep) for number in (signal.SIGINT, signal.SIGTERM) if main}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in kept:
            signal.raise_signal(number)
