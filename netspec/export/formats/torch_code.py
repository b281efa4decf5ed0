"""A net as the statements of a PyTorch program, layer by layer."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from netspec.export.formats.shapes import Fixed, NetShapes
from netspec.export.formats.source import MARK, Module, Program, Statement, mark, number
from netspec.graph.fold import origins
from netspec.layers.contract.base import Layer
from netspec.layers.contract.exporting import export
from netspec.layers.contract.folding import folds_of
from netspec.layers.contract.targets import Sizes
from netspec.net.net import Net

_FIELD = re.compile(r"\{(\w+)\}")
_ONE_MARK = re.compile(f"^{MARK.pattern}$")


def write_program(net: Net, shapes: NetShapes) -> Program:
    """Return the program of a net. Raises SpecError where a layer cannot be written."""
    collector = _Collector(net, shapes)
    plan = net.plan
    for i, node in enumerate(plan.nodes):
        bottoms = [mark("v", collector.value[v]) for v in node.bottoms]
        layer_code = _LayerCode(collector, i)
        tops = export(net.layers[i], layer_code, "PyTorch", *bottoms)
        collector.add(i, node.tops, tops)
    collector.program.outputs = {name: collector.value[v] for name, v in plan.outputs.items()}
    return collector.program


class _Collector:
    """What the layers have written so far."""

    def __init__(self, net: Net, shapes: NetShapes) -> None:
        self.net, self.shapes = net, shapes
        self.program = Program(names=dict(enumerate(net.plan.blobs)))
        self.value = list(range(len(net.plan.blobs)))  # value of the Plan -> value of the program
        passes = [folds_of(layer).passes_on for layer in net.layers]
        origin = origins(net.plan, passes)
        self.readers = [0] * len(self.value)
        for node, passed in zip(net.plan.nodes, passes, strict=True):
            for v in node.bottoms if not passed else ():
                self.readers[origin[v]] += 1
        for v in net.plan.outputs.values():
            self.readers[origin[v]] += 1
        self.made_by: dict[int, Statement] = {}
        self.modules_of: list[tuple[frozenset[int], int]] = []  # the learned blobs of a module, and its number

    def add(self, index: int, targets: Sequence[int], tops: str | Sequence[str]) -> None:
        """Add the statements of a layer."""
        node = self.net.plan.nodes[index]
        if isinstance(tops, str):
            groups = [(tuple(targets), tops)]
        else:
            groups = [((v,), top) for v, top in zip(targets, tops, strict=True)]
        shape = self.net.layers[index].bottom_shapes[:1]
        for values, expression in groups:
            passed_on = _ONE_MARK.match(expression)
            if passed_on and passed_on[1] == "v" and len(values) == 1:
                self.value[values[0]] = int(passed_on[2])
                continue
            keeps = len(values) == 1 and shape == self.net.layers[index].top_shapes
            statement = Statement(values, expression, node.name, keeps)
            self.program.statements.append(statement)
            self.made_by.update(dict.fromkeys(values, statement))


class _LayerCode:
    """See :class:`netspec.layers.contract.targets.TorchCode`."""

    def __init__(self, collector: _Collector, index: int) -> None:
        self.collector, self.program = collector, collector.program
        self.layer: Layer = collector.net.layers[index]
        self.plan_node = collector.net.plan.nodes[index]

    def call(self, template: str, **values: Any) -> str:
        def fill(match: re.Match[str]) -> str:
            value = values[match[1]]
            return value if isinstance(value, str) else number(value)

        return _FIELD.sub(fill, template)

    def module(
        self, template: str, state: Mapping[str, torch.Tensor], usual: Mapping[str, Any] | None = None, **values: Any
    ) -> str:
        own = frozenset(id(blob) for blob in self.layer.blobs)
        for blobs, known in self.collector.modules_of:
            module = self.program.modules[known]
            if own and own == blobs and (module.template, module.numbers) == (template, values):
                return mark("m", known)
        return self._add(Module(self.plan_node.name, template, values, _copies(state), usual=dict(usual or {})), own)

    def parameter(self, index: int, shape: Sequence[int] | None = None, name: str = "") -> str:
        values = self.layer.blob(index)
        shaped = values if shape is None else values.reshape(tuple(shape))
        own = frozenset([id(self.layer.blobs[index])])
        for blobs, known in self.collector.modules_of:
            if own == blobs and self.program.modules[known].numbers == {"shape": tuple(shaped.shape)}:
                return mark("m", known)
        return self._stored("nn.Parameter(torch.zeros({shape}))", shaped, own, name)

    def buffer(self, values: torch.Tensor) -> str:
        return self._stored("torch.zeros({shape})", values, frozenset(), kind="buffer")

    def _stored(
        self, template: str, values: torch.Tensor, blobs: frozenset[int], name: str = "", kind: str = "module"
    ) -> str:
        layer = " ".join([self.plan_node.name, *([name] if name else [])])
        numbers = {"shape": tuple(values.shape)}
        return self._add(Module(layer, template, numbers, _copies({"": values}), kind), blobs)

    def _add(self, module: Module, blobs: frozenset[int]) -> str:
        self.program.modules.append(module)
        self.collector.modules_of.append((blobs, len(self.program.modules) - 1))
        return mark("m", len(self.program.modules) - 1)

    def function(self, function: Callable[..., Any]) -> str:
        self.program.functions[function.__name__] = function
        return function.__name__

    def affine(self, value: str, scale: torch.Tensor, shift: torch.Tensor) -> bool:
        match = _ONE_MARK.match(value)
        if not match or match[1] != "v" or self.collector.readers[int(match[2])] != 1:
            return False
        statement = self.collector.made_by.get(int(match[2]))
        if statement is None or len(statement.modules()) != 1 or not statement.expression.startswith("\x02m"):
            return False
        number = statement.modules()[0]
        module = self.program.modules[number]
        uses = sum(number in other.modules() for other in self.program.statements)
        affine = {"weight": scale, "bias": shift}
        if uses > 1 and not module.template.count("affine=False"):  # towers that share it
            return all(torch.equal(module.state[name], tensor) for name, tensor in affine.items())
        if ", affine=False" not in module.template or uses > 1:
            return False
        module.template = module.template.replace(", affine=False", "")
        module.state.update(_copies(affine))
        return True

    def sizes(self, bottom: int) -> Sizes:
        return self.collector.shapes.sizes(self.plan_node.bottoms[bottom])

    def size(self, bottom: int, axis: int, why: str) -> int:
        value = self.plan_node.bottoms[bottom]
        if self.collector.shapes.chosen(value, axis):
            raise Fixed(value, axis, f'layer "{self.plan_node.name}" ({self.layer.type}): {why}')
        return self.collector.shapes.built[value][axis]

    def reshape_to_top(self, value: str, bottom: int = 0, top: int = 0) -> str:
        shapes, source, target = self.collector.shapes, self.plan_node.bottoms[bottom], self.plan_node.tops[top]
        before, after, sizes = shapes.built[source], shapes.built[target], shapes.sizes(target)
        if before == after:
            return value
        most = min(len(before), len(after)) - 1
        head = tail = 0
        while head < most and shapes.same((source, head), (target, head)):
            head += 1
        while tail < most - head and shapes.same((source, len(before) - 1 - tail), (target, len(after) - 1 - tail)):
            tail += 1
        merged, made = len(before) - tail - 1, sizes[head : len(after) - tail]
        free = [axis for axis, size in enumerate(sizes) if size is None]
        if len(free) <= 1 and len(made) > 1:
            return f"{value}.reshape({', '.join('-1' if size is None else str(size) for size in sizes)})"
        if made.count(None) > 1:
            raise Fixed(
                target, head + made.index(None), f'layer "{self.plan_node.name}" ({self.layer.type}): it is reshaped'
            )
        if merged > head:
            axes = "" if head == 0 and tail == 0 else f"{head}" if tail == 0 else f"{head}, {merged}"
            value = f"{value}.flatten({axes})"
        if len(made) == 1:
            return value
        return f"{value}.unflatten({head}, ({', '.join('-1' if size is None else str(size) for size in made)}))"

    def input(self, top: int) -> str:
        value = self.plan_node.tops[top]
        self.program.inputs.append(value)
        return mark("v", value)


def _copies(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().cpu().float().contiguous().clone() for name, tensor in state.items()}
