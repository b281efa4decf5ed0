"""A net as a PyTorch module that computes the same as the exported source.

It does not write and run source: the expressions of the layers are evaluated one by one.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from netspec.export.expression import TRAINING, Submodule, evaluate
from netspec.export.formats.shapes import check_shapes, input_shapes, settled
from netspec.export.formats.source import legal, unique
from netspec.export.formats.torch_code import Definition, write_definition
from netspec.net.net import Net


def torch_module(net: Net) -> nn.Module:
    """Return a module for inference that computes the same as the exported source, with its weights."""
    definition, shapes = settled(net, lambda shapes: write_definition(net, shapes))
    return _Defined(definition, input_shapes(net, shapes)).eval()


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
