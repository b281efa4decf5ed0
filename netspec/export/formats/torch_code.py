"""Builds the source of a PyTorch module, layer by layer: its statements and submodules.

In the text of an expression, marks stand for values and modules. They are replaced by names at the end.
"""

from __future__ import annotations

import ast
import builtins
import keyword
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from netspec.export.formats.shapes import Fixed, NetShapes
from netspec.export.table import exported, refusal
from netspec.export.targets import Sizes, TorchCode
from netspec.graph.plan import origins
from netspec.layers.contract.base import Layer
from netspec.net.net import Net

WIDTH = 88  # ruff's and black's line length where nothing else is configured
MARK = re.compile("\x02([vm])(\\d+)\x03")  # a value, a module
_TAKEN = {"self", "x", "torch", "nn", "F", "math", "Path", "load_file", "load", "forward", "main", "expected"}
_TAKEN |= {name for name in dir(torch.nn.Module) if not name.startswith("__")} | {"training", "T_destination"}


def mark(kind: str, number: int) -> str:
    """Return the mark of a value (v) or a module (m)."""
    return f"\x02{kind}{number}\x03"


@dataclass(eq=False)
class Module:
    """A submodule, or a parameter or buffer of the module: its constructor call, and its tensors by name.

    ``numbers`` are the values for the fields of the template. Arguments with their ``usual`` value are left out.
    """

    layer: str
    template: str
    numbers: dict[str, Any]
    state: dict[str, torch.Tensor]
    kind: str = "module"  # or "buffer"
    usual: dict[str, Any] = field(default_factory=dict)

    def constructor(self) -> str:
        """Return the constructor's call."""
        template = self.template
        for name, value in self.usual.items():
            if self.numbers[name] == value:
                template = template.replace(f", {name}={{{name}}}", "")
        return template.format(**{name: number(value) for name, value in self.numbers.items()})

    def tensors(self, prefix: str) -> dict[str, torch.Tensor]:
        """Return all tensors by their names in a state_dict, for the attribute ``prefix``."""
        state = _copies(self.state)
        return {f"{prefix}.{name}" if name else prefix: tensor for name, tensor in state.items()}


@dataclass(eq=False)
class Statement:
    """Values from an expression."""

    targets: tuple[int, ...]
    expression: str

    def values(self) -> list[int]:
        """Return the values that it reads, in order, with repetitions."""
        return [int(number) for kind, number in MARK.findall(self.expression) if kind == "v"]

    def modules(self) -> list[int]:
        """Return the modules that it uses, in order."""
        return [int(number) for kind, number in MARK.findall(self.expression) if kind == "m"]


@dataclass
class Definition:
    """A complete module: its inputs, outputs and statements.

    ``names`` are the names of the blobs, by value. ``inputs`` and ``outputs`` are values. ``modules`` are the modules
    of the marks. ``functions`` are copied into the file.
    """

    statements: list[Statement] = field(default_factory=list)
    modules: list[Module] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    inputs: list[int] = field(default_factory=list)
    outputs: dict[str, int] = field(default_factory=dict)
    functions: dict[str, Callable[..., Any]] = field(default_factory=dict)

    def attributes(self) -> dict[int, str]:
        """Return the attribute names of the modules, in the order of their use."""
        taken: set[str] = set()
        used = dict.fromkeys(m for statement in self.statements for m in statement.modules())
        return {m: unique(legal(self.modules[m].layer), taken) for m in used}


# Names: text from a file becomes only identifiers or quoted strings in the source


def legal(name: str, prefix: str = "layer_") -> str:
    """Return a legal Python name for a layer or a blob."""
    text = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or prefix.rstrip("_")
    return _free(prefix + text if text[0].isdigit() else text, "_")


def _free(identifier: str, ending: str) -> str:
    """Return an identifier, with a suffix if Python or the file already uses the name."""
    used = keyword.iskeyword(identifier) or identifier in _TAKEN or hasattr(builtins, identifier)
    return identifier + ending if used else identifier


def quoted(text: str) -> str:
    """Return a text as a literal in double quotes; without the quotes, it can also be part of a docstring."""
    return '"' + repr('"' + text)[2:-1].replace('"', '\\"') + '"'


def unique(name: str, taken: set[str]) -> str:
    """Return a name that is not in ``taken``, and add it there."""
    found, k = name, 2
    while found in taken:
        found, k = f"{name}_{k}", k + 1
    taken.add(found)
    return found


def class_name(text: str) -> str:
    """Return a class name made from the words of a text."""
    words = [word for word in re.split(r"[^0-9A-Za-z]+", text) if word]
    name = "".join(word[0].upper() + word[1:] for word in words) or "Net"
    return _free(f"Net{name}" if name[0].isdigit() else name, "Net")


def number(value: Any) -> str:
    """Return a number, a bool or a tuple of them as source; floats with as few digits as float32 allows.

    A text (the name of a dynamic size) is quoted.
    """
    if isinstance(value, (tuple, list)):
        inner = ", ".join(number(v) for v in value)
        return f"[{inner}]" if isinstance(value, list) else f"({inner},)" if len(value) == 1 else f"({inner})"
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, float):
        short = float(str(np.float32(value)))
        return repr(short) if np.isfinite(short) else f"{'-' * (short < 0)}torch.{abs(short)}"
    return repr(value)


# Layout


def lay_out(statement: str, indent: int) -> list[str]:
    """Return a statement as lines. If it is longer than ``WIDTH``, each part of the widest bracket is a line."""
    space = " " * indent
    whole = [space + statement]
    if indent + len(statement) <= WIDTH:
        return whole
    brackets = [found for node in ast.walk(ast.parse(statement)) if (found := _parts(node))]
    if not brackets:
        return whole
    parts = max(brackets, key=lambda found: found[-1][1] - found[0][0])
    text = statement.encode()  # ast counts bytes
    lines = [space + text[: parts[0][0]].decode()]
    for start, end in parts:
        broken = lay_out(text[start:end].decode(), indent + 4)
        lines += [*broken[:-1], f"{broken[-1]},"]
    return [*lines, space + text[parts[-1][1] :].decode()]


def _parts(node: ast.AST) -> list[tuple[int, int]]:
    """Return the begin and end of each part in the brackets of a call, a list or a tuple; nothing for other nodes."""
    if isinstance(node, ast.Call):
        inside = [*node.args, *node.keywords]
        if any(isinstance(part, ast.GeneratorExp) for part in inside):
            return []  # a comma may not stand behind one
    else:
        inside = node.elts if isinstance(node, (ast.List, ast.Tuple)) else []
        if inside and inside[0].col_offset == getattr(node, "col_offset", 0):
            return []  # a tuple without brackets
    return [(part.col_offset, part.end_col_offset or 0) for part in inside]


def check_shapes(expected, *inputs):
    """Raise an error for inputs of other shapes. A name stands for any size, and equal names for equal sizes."""
    sizes = {}
    for (name, shape), x in zip(expected.items(), inputs, strict=True):
        for size, wanted in zip(x.shape, shape, strict=False):
            if isinstance(wanted, str):
                sizes.setdefault(wanted, size)
        shape = tuple(sizes.get(wanted, wanted) for wanted in shape)
        if tuple(x.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(x.shape)}, expected {shape}")


_FIELD = re.compile(r"\{(\w+)\}")
_ONE_MARK = re.compile(f"^{MARK.pattern}$")


def write_definition(net: Net, shapes: NetShapes) -> Definition:
    """Return the definition of a net. Raises SpecError if a layer cannot be exported."""
    collector = _Collector(net, shapes)
    plan = net.plan
    for i, node in enumerate(plan.nodes):
        bottoms = [mark("v", collector.value[v]) for v in node.bottoms]
        tops = _write_layer(net.layers[i], _LayerCode(collector, i), *bottoms)
        collector.add(node.tops, tops)
    collector.made.outputs = {name: collector.value[v] for name, v in plan.outputs.items()}
    return collector.made


def _write_layer(layer: Layer, code: TorchCode, *bottoms: str) -> str | Sequence[str]:
    """Write a layer; return the expressions of its tops. Raises SpecError if it cannot be exported."""
    write, template = exported(layer, "to_torch"), exported(layer, "torch_call")
    if write is not None:
        return write(code, *bottoms)
    if template is None:
        raise refusal(layer, "PyTorch")
    given = dict(zip("xyz", bottoms, strict=False))
    return code.call(template, **{n: given[n] if n in given else getattr(layer, n) for n in _FIELD.findall(template)})


class _Collector:
    """Collects what the layers write."""

    def __init__(self, net: Net, shapes: NetShapes) -> None:
        self.net, self.shapes = net, shapes
        self.made = Definition(names=dict(enumerate(net.plan.blobs)))
        self.value = list(range(len(net.plan.blobs)))  # value of the Plan -> value of the program
        passes = [layer.passes_on for layer in net.layers]
        origin = origins(net.plan, passes)
        self.readers = [0] * len(self.value)
        for node, passed in zip(net.plan.nodes, passes, strict=True):
            for v in node.bottoms if not passed else ():
                self.readers[origin[v]] += 1
        for v in net.plan.outputs.values():
            self.readers[origin[v]] += 1
        self.made_by: dict[int, Statement] = {}
        self.modules_of: list[tuple[tuple[int, ...], int]] = []  # the learnable blobs of a module, and its number

    def add(self, targets: Sequence[int], tops: str | Sequence[str]) -> None:
        """Add the statements of a layer."""
        if not targets:
            groups = []
        elif isinstance(tops, str):
            groups = [(tuple(targets), tops)]
        else:
            groups = [((v,), top) for v, top in zip(targets, tops, strict=False)]  # a loss may have no top
        for values, expression in groups:
            passed_on = _ONE_MARK.match(expression)
            if passed_on and passed_on[1] == "v" and len(values) == 1:
                self.value[values[0]] = int(passed_on[2])
                continue
            statement = Statement(values, expression)
            self.made.statements.append(statement)
            self.made_by.update(dict.fromkeys(values, statement))


class _LayerCode:
    """See :class:`netspec.export.targets.TorchCode`."""

    def __init__(self, collector: _Collector, index: int) -> None:
        self.collector, self.made = collector, collector.made
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
        own = tuple(id(blob) for blob in self.layer.blobs)
        for blobs, known in self.collector.modules_of:
            module = self.made.modules[known]
            same = own and own == blobs and (module.template, module.numbers) == (template, values)
            if same and _same(module.state, state):
                return mark("m", known)
        return self._add(Module(self.plan_node.name, template, values, dict(state), usual=dict(usual or {})), own)

    def parameter(self, index: int, shape: Sequence[int] | None = None, name: str = "") -> str:
        values = self.layer.blob(index)
        shaped = values if shape is None else values.reshape(tuple(shape))
        own = (id(self.layer.blobs[index]),)
        for blobs, known in self.collector.modules_of:
            if own == blobs and self.made.modules[known].numbers == {"shape": tuple(shaped.shape)}:
                return mark("m", known)
        return self._stored("nn.Parameter(torch.zeros({shape}))", shaped, own, name)

    def buffer(self, values: torch.Tensor) -> str:
        return self._stored("torch.zeros({shape})", values, (), kind="buffer")

    def _stored(
        self, template: str, values: torch.Tensor, blobs: tuple[int, ...], name: str = "", kind: str = "module"
    ) -> str:
        layer = " ".join([self.plan_node.name, *([name] if name else [])])
        numbers = {"shape": tuple(values.shape)}
        return self._add(Module(layer, template, numbers, {"": values}, kind), blobs)

    def _add(self, module: Module, blobs: tuple[int, ...]) -> str:
        self.made.modules.append(module)
        self.collector.modules_of.append((blobs, len(self.made.modules) - 1))
        return mark("m", len(self.made.modules) - 1)

    def function(self, function: Callable[..., Any]) -> str:
        self.made.functions[function.__name__] = function
        return function.__name__

    def affine(self, value: str, scale: torch.Tensor, shift: torch.Tensor) -> bool:
        match = _ONE_MARK.match(value)
        if not match or match[1] != "v" or self.collector.readers[int(match[2])] != 1:
            return False
        statement = self.collector.made_by.get(int(match[2]))
        if statement is None or len(statement.modules()) != 1 or not statement.expression.startswith("\x02m"):
            return False
        number = statement.modules()[0]
        module = self.made.modules[number]
        uses = sum(number in other.modules() for other in self.made.statements)
        affine = {"weight": scale, "bias": shift}
        if uses > 1 and not module.template.count("affine=False"):  # branches that share it
            return all(torch.equal(module.state[name], tensor) for name, tensor in affine.items())
        if ", affine=False" not in module.template or uses > 1:
            return False
        module.template = module.template.replace(", affine=False", "")
        module.state.update(affine)
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
        self.made.inputs.append(value)
        return mark("v", value)


def _same(first: Mapping[str, torch.Tensor], second: Mapping[str, torch.Tensor]) -> bool:
    """Return whether two states have the same tensors in the same roles; a transposed one is another tensor."""
    return first.keys() == second.keys() and all(
        a.stride() == b.stride() and torch.equal(a, b) for a, b in zip(first.values(), second.values(), strict=True)
    )


def _copies(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().cpu().float().contiguous().clone() for name, tensor in state.items()}
