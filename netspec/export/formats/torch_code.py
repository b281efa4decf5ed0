"""Collects what the layers of a net compute in PyTorch: the statements of a module, and what it stores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch

from netspec.export.exporter import exporter_of
from netspec.export.expression import Expression, Stored, Submodule, Value, parts
from netspec.export.formats.shapes import LayerShapes, NetShapes, is_given
from netspec.export.formats.source import legal, unique
from netspec.graph.plan import origins
from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import values_of
from netspec.net.net import Net


@dataclass
class Definition:
    """A complete module: its inputs and outputs, by value, and its statements, an expression for some values each."""

    blobs: Sequence[str]  # the name of each value's blob
    values: Sequence[Value]
    statements: list[tuple[tuple[int, ...], Expression]] = field(default_factory=list)
    inputs: list[int] = field(default_factory=list)
    outputs: dict[str, int] = field(default_factory=dict)
    passed: list[int] = field(default_factory=list)  # for each value, the one that it is; a layer may pass a value on

    @cached_property
    def attributes(self) -> dict[Stored | Submodule, str]:
        """The names of the submodules, parameters and buffers, in the order of their use."""
        taken: set[str] = set()
        used = (part for _, expression in self.statements for part in parts(expression))
        stored = dict.fromkeys(part for part in used if isinstance(part, (Stored, Submodule)))
        return {each: unique(legal(each.layer), taken) for each in stored}

    def state(self) -> dict[str, torch.Tensor]:
        """Return the state_dict of the module. Its tensors may share the net's memory."""
        tensors = {k: v for stored, name in self.attributes.items() for k, v in stored.tensors(name).items()}
        return {name: values_of(tensor).cpu().float().contiguous() for name, tensor in tensors.items()}


def write_definition(net: Net, shapes: NetShapes, onnx: bool = False) -> Definition:
    """Return the definition of a net, or with ``onnx`` the one from which its ONNX model is made.

    Raises SpecError if a layer cannot be exported.
    """
    code = TorchCode(net, shapes, onnx)
    for layer, node in zip(net.layers, net.plan.nodes, strict=True):
        code.layer, code.plan_node = layer, node
        bottoms = tuple(code.values[v] for v in node.bottoms)
        if layer in code.absorbed:
            code.add(node.tops, bottoms[:1])
        elif is_given(layer):
            code.add(node.tops, [code.input(i) for i in range(layer.num_tops)])
        else:
            code.add(node.tops, exporter_of(layer)(code, *bottoms))
    code.definition.passed = [value.number for value in code.values]
    code.definition.outputs = {name: code.values[v].number for name, v in net.plan.outputs.items()}
    return code.definition


class TorchCode(LayerShapes):
    """The PyTorch module that is being written, as the layer sees it that is written now."""

    def __init__(self, net: Net, shapes: NetShapes, onnx: bool = False) -> None:
        self.onnx = onnx
        self.net, self.shapes = net, shapes
        self.values = [Value(v) for v in range(len(net.plan.blobs))]  # a layer may pass a value on
        self.definition = Definition(net.plan.blobs, tuple(self.values))
        self.absorbed: dict[Layer, Layer] = {}  # a layer -> the one that computes it too
        self._stored: list[Stored | Submodule] = []
        self._readers = _readers(net)

    def module(
        self, cls: type[torch.nn.Module], *args: Any, state: Mapping[str, torch.Tensor], **options: Any
    ) -> Submodule:
        """Add a submodule, named after the layer: ``code.module(nn.Linear, 3, 4, state={"weight": w, "bias": b})``.

        ``state`` has its parameters and buffers by their names in it. Layers with the same learnable blobs in the same
        roles share it.
        """
        absorbed = [blob for after, by in self.absorbed.items() if by is self.layer for blob in after.blobs]
        blobs = (*self.layer.blobs, *absorbed)
        return self._added(Submodule(self.plan_node.name, cls, args, options, dict(state), blobs))

    def parameter(self, index: int, shape: Sequence[int] | None = None, name: str = "") -> Stored:
        """Return a learnable blob as a parameter of the module itself, in this shape.

        It is named after the layer, and ``name`` where the layer has several.
        """
        blob = self.layer.blob(index)
        shaped = blob if shape is None else blob.reshape(tuple(shape))
        return self._added(Stored(f"{self.plan_node.name} {name}".strip(), shaped, True, (self.layer.blobs[index],)))

    def buffer(self, values: torch.Tensor) -> Stored:
        """Return constants that are stored with the weights."""
        return self._added(Stored(self.plan_node.name, values, learned=False))

    def _added(self, stored: Any) -> Any:
        known = next((other for other in self._stored if stored.same_as(other)), None)
        if known is None:
            self._stored.append(stored)
        return known or stored

    def absorb(self, suits: Callable[[Layer], bool]) -> Any:
        """Return the layer that alone reads the top, if it suits, or None.

        The layer that is written now computes what that one does, which passes its bottom on.
        """
        readers = self._readers[self.plan_node.tops[0]]
        after = readers[0] if len(readers) == 1 else None
        if after is None or not suits(after):
            return None
        self.absorbed[after] = self.layer
        return after

    def reshape_to_top(self, x: Expression, bottom: int = 0, top: int = 0) -> Expression:
        """Return a bottom's value in the shape of a top of the layer, whatever the free sizes are."""
        shapes, source, target = self.shapes, self.plan_node.bottoms[bottom], self.plan_node.tops[top]
        before, after, sizes = shapes.built[source], shapes.built[target], shapes.sizes(target)
        if before == after:
            return x
        most = min(len(before), len(after)) - 1
        head = tail = 0
        while head < most and shapes.same((source, head), (target, head)):
            head += 1
        while tail < most - head and shapes.same((source, len(before) - 1 - tail), (target, len(after) - 1 - tail)):
            tail += 1
        last, made = len(before) - tail - 1, sizes[head : len(after) - tail]
        if sizes.count(None) <= 1 and len(made) > 1:
            return x.reshape(*(-1 if size is None else size for size in sizes))
        if made.count(None) > 1:
            raise self.fixed(target, head + made.index(None), "it is reshaped")
        if last > head:
            x = x.flatten(head, last) if tail else x.flatten(*([head] if head else []))
        return x if len(made) == 1 else x.unflatten(head, tuple(-1 if size is None else size for size in made))

    def input(self, top: int) -> Value:
        """Return a new argument of ``forward``, for a top that its caller gives."""
        value = self.values[self.plan_node.tops[top]]
        self.definition.inputs.append(value.number)
        return value

    def add(self, targets: Sequence[int], tops: Expression | Sequence[Expression]) -> None:
        """Add the statements of a layer: of each top, or of all of them where ``tops`` is one expression."""
        if isinstance(tops, Expression):
            made = [(tuple(targets), tops)] if targets else []
        else:
            made = [((v,), top) for v, top in zip(targets, tops, strict=False)]  # a loss may have no top
        for values, expression in made:
            if isinstance(expression, Value) and len(values) == 1:
                self.values[values[0]] = expression
            else:
                self.definition.statements.append((values, expression))


def _readers(net: Net) -> dict[int, list[Layer | None]]:
    """Return the layers that read each value, directly or as it is passed on; None stands for the caller."""
    passes = [layer.passes_on for layer in net.layers]
    origin = origins(net.plan, passes)
    found: dict[int, list[Layer | None]] = {v: [] for v in origin}
    for layer, node, passed in zip(net.layers, net.plan.nodes, passes, strict=True):
        for v in node.bottoms if not passed else ():
            found[origin[v]].append(layer)
    for v in net.plan.outputs.values():
        found[origin[v]].append(None)
    return found
