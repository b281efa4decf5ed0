"""``--to pt2``: writes a net as a torch.export archive, which computes the same as the exported source.

It does not write and run source: the expressions of the layers are evaluated one by one.
"""

from __future__ import annotations

import inspect
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from netspec.errors import SpecError, Where
from netspec.export.exporter import layer_notes
from netspec.export.expression import TRAINING, Submodule, evaluate
from netspec.export.formats.shapes import NetShapes, check_shapes, input_shapes, settled
from netspec.export.formats.source import legal, unique
from netspec.export.formats.torch_code import Definition, write_definition
from netspec.files.whole_file import whole_file
from netspec.net.net import Net
from netspec.proto.schema import TRAIN


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
        for stored, name in definition.attributes.items():
            if isinstance(stored, Submodule):
                setattr(self, name, stored.cls(*stored.args, **stored.options))
            elif stored.learned:
                setattr(self, name, nn.Parameter(torch.zeros(stored.values.shape)))
            else:
                self.register_buffer(name, torch.zeros(stored.values.shape))
        self.load_state_dict(definition.state())

        taken: set[str] = set()
        arguments = [unique(legal(definition.blobs[v], "blob_"), taken) for v in definition.inputs]
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
        known: dict[Any, Any] = {each: getattr(self, name) for each, name in definition.attributes.items()}
        known[TRAINING] = self.training
        known.update((definition.values[v], x) for v, x in zip(definition.inputs, inputs, strict=True))
        for targets, expression in definition.statements:
            made = evaluate(expression, known)
            tops = made if len(targets) > 1 else (made,)
            known.update((definition.values[v], x) for v, x in zip(targets, tops, strict=True))
        outputs = {name: known[definition.values[v]] for name, v in definition.outputs.items()}
        return outputs if len(outputs) != 1 else next(iter(outputs.values()))
