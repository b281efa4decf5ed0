"""``--to pt2``: writes a net as a torch.export archive, which computes the same as the exported source.

It does not write and run source: the expressions of the layers are parsed and computed one by one.
"""

from __future__ import annotations

import ast
import inspect
import io
import math
import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from netspec.errors import SpecError, Where
from netspec.export.formats.shapes import NetShapes, input_shapes, settled
from netspec.export.formats.torch_code import MARK, Definition, check_shapes, legal, unique, write_definition
from netspec.export.table import layer_notes
from netspec.files.whole_file import whole_file
from netspec.net.net import Net
from netspec.proto.schema import TRAIN

OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
    ast.NotEq: operator.ne,
}


def export_pt2(net: Net, path: str | Path) -> list[str]:
    """Write a net as a torch.export archive; return notes for its user.

    The sizes are dynamic as in the exported source if torch.export supports it, otherwise only the batch, or none.
    Raises SpecError if torch.export cannot export the net, or if the file cannot be written.
    """
    module, shapes = _module_and_shapes(net)
    module.training = net.phase == TRAIN  # Dropout drops; modules such as BatchNorm2d keep what they learned
    inputs = [v for node, layer in zip(net.plan.nodes, net.layers, strict=True) if layer.is_input for v in node.tops]
    notes = [*shapes.fixed, *layer_notes(net.layers)]
    every = [free.name for free in shapes.free if not free.counted]
    for names in (*([every] if len(every) > 1 else []), *([["N"]] if "N" in every else []), []):
        dims = {free.name: torch.export.Dim.AUTO for free in shapes.free if free.name in names}
        axes = {axis: free.name for free in shapes.free for axis in free.axes if free.name in dims}
        dynamic = [
            {axis: dims[axes[v, axis]] for axis in range(len(shapes.built[v])) if (v, axis) in axes} for v in inputs
        ]
        example = []
        for v in inputs:  # torch.export treats a size of 1 as a constant
            sizes = [max(2, size) if (v, axis) in axes else size for axis, size in enumerate(shapes.built[v])]
            example.append(torch.zeros(sizes))
        try:
            program = torch.export.export(module, tuple(example), dynamic_shapes=tuple(dynamic), strict=False)
        except Exception as fault:
            reason = str(fault).strip().splitlines()
            if not names:
                raise SpecError(f"torch.export failed: {reason[0] if reason else fault}", Where(str(path))) from fault
            continue
        with whole_file(path) as unfinished:
            buffer = io.BytesIO()
            torch.export.save(program, buffer)
            unfinished.write_bytes(buffer.getvalue())
        fixed = [free.name for free in shapes.free if not free.counted and free.name not in names]
        return [*notes, *([f"torch.export fixes the sizes {' and '.join(fixed)}"] if fixed else [])]
    raise AssertionError("the last choice has no dynamic size")


def torch_module(net: Net) -> nn.Module:
    """Return a module for inference that computes the same as the exported source, with its weights."""
    return _module_and_shapes(net)[0]


def _module_and_shapes(net: Net) -> tuple[nn.Module, NetShapes]:
    definition, shapes = settled(net, lambda shapes: write_definition(net, shapes))
    return _Defined(definition, input_shapes(net, shapes)).eval(), shapes


class _Defined(nn.Module):
    """A module that evaluates the expressions of a definition one by one."""

    def __init__(self, definition: Definition, expected: Mapping[str, tuple[int | str, ...]]) -> None:
        super().__init__()
        self.definition, self.expected = definition, expected
        self.attributes = definition.attributes()
        libraries = {"torch": torch, "nn": nn, "F": F, "math": math}
        self.known = {**libraries, **definition.functions}
        state = {}
        for m, attribute in self.attributes.items():
            module = definition.modules[m]
            made = _value(_parsed(module.constructor()), libraries)
            if module.kind == "buffer":
                self.register_buffer(attribute, made)
            else:
                setattr(self, attribute, made)
            state.update(module.tensors(attribute))
        self.load_state_dict(state)
        self.steps = [(statement.targets, _parsed(statement.expression)) for statement in definition.statements]

        taken = set(definition.functions)
        arguments = [unique(legal(definition.names[v], "blob_"), taken) for v in definition.inputs]
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        self.signature = inspect.Signature([inspect.Parameter(name, kind) for name in arguments])

        def forward(*inputs: torch.Tensor, **named: torch.Tensor) -> Any:
            return self._outputs(*self.signature.bind(*inputs, **named).args)

        forward.__signature__ = self.signature  # pyright: ignore[reportFunctionMemberAccess]
        self.forward = forward

    def _outputs(self, *inputs: torch.Tensor) -> Any:
        """Return the output, or a dict of the outputs if there are several."""
        definition = self.definition
        check_shapes(self.expected, *inputs)
        names = {**self.known, "self": self, **{f"v{v}": x for v, x in zip(definition.inputs, inputs, strict=True)}}
        names.update({f"m{m}": getattr(self, attribute) for m, attribute in self.attributes.items()})
        for targets, expression in self.steps:
            made = _value(expression, names)
            names.update({f"v{v}": x for v, x in zip(targets, made if len(targets) > 1 else (made,), strict=True)})
        outputs = {name: names[f"v{v}"] for name, v in definition.outputs.items()}
        return outputs if len(outputs) != 1 else next(iter(outputs.values()))


def _parsed(expression: str) -> ast.expr:
    """Return the syntax tree of an expression, with names such as v3 for its marks."""
    return ast.parse(MARK.sub(r"\1\2", expression), mode="eval").body


def _value(node: ast.AST | None, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression, for the kinds of expressions that layers write."""
    match node:
        case None | ast.Constant():
            return None if node is None else node.value
        case ast.Name():
            return names[node.id]
        case ast.Attribute():
            return getattr(_value(node.value, names), node.attr)
        case ast.Tuple():
            return tuple(_value(each, names) for each in node.elts)
        case ast.List():
            return [_value(each, names) for each in node.elts]
        case ast.Subscript():
            return _value(node.value, names)[_value(node.slice, names)]
        case ast.Slice():
            return slice(_value(node.lower, names), _value(node.upper, names), _value(node.step, names))
        case ast.UnaryOp():
            return OPERATORS[type(node.op)](_value(node.operand, names))
        case ast.BinOp():
            return OPERATORS[type(node.op)](_value(node.left, names), _value(node.right, names))
        case ast.Compare(ops=[operation], comparators=[right]):
            return OPERATORS[type(operation)](_value(node.left, names), _value(right, names))
        case ast.Call():
            arguments = [_value(each, names) for each in node.args]
            options = {keyword.arg: _value(keyword.value, names) for keyword in node.keywords if keyword.arg}
            return _value(node.func, names)(*arguments, **options)
    raise AssertionError(f"a layer wrote {ast.dump(node)}")
