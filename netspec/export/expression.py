"""What an exported layer computes, as an expression of PyTorch: values, submodules, and calls of functions.

An exporter writes it as it would write PyTorch, with operators, indices and methods of tensors; a function, or a helper
of its own module, is called by :func:`call`::

    return call(F.leaky_relu, x, 0.1)            # F.leaky_relu(x, 0.1)
    return (x - y).square().sum() / x.shape[0]
    return code.module(nn.Linear, 3, 4, state={"weight": w, "bias": b})(x.flatten(1))

An expression is read by the printer of the PyTorch source (formats/source.py), and by :func:`evaluate`
(formats/onnx.py).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch


class Expression:
    """A value that is known when the exported net runs: a tensor, or something else in an expression, as a shape."""

    __iter__ = None  # a value of several tops is not unpacked here, but by the statement that it becomes

    def __add__(self, other: Any) -> Call:
        return call(operator.add, self, other)

    def __radd__(self, other: Any) -> Call:
        return call(operator.add, other, self)

    def __sub__(self, other: Any) -> Call:
        return call(operator.sub, self, other)

    def __mul__(self, other: Any) -> Call:
        return call(operator.mul, self, other)

    def __rmul__(self, other: Any) -> Call:
        return call(operator.mul, other, self)

    def __truediv__(self, other: Any) -> Call:
        return call(operator.truediv, self, other)

    def __neg__(self) -> Call:
        return call(operator.neg, self)

    def __getitem__(self, index: Any) -> Call:
        return call(operator.getitem, self, index)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of a tensor: ``x.shape``, or a method, ``x.flatten(1)``."""
        if name.startswith("_"):
            raise AttributeError(name)
        found = getattr(torch.Tensor, name)
        if not callable(found):
            return call(getattr, self, name)
        return lambda *args, **options: call(found, self, *args, **options)


@dataclass(frozen=True, eq=False)
class Value(Expression):
    """A blob of the net, by its number in the Plan."""

    number: int


class _Training(Expression):
    """Whether the module is in training mode."""


TRAINING = _Training()


@dataclass(frozen=True, eq=False)
class Call(Expression):
    """A call of a function of torch, of a method of tensors, of an operator, or of a submodule."""

    function: Callable[..., Any]
    args: tuple[Any, ...]
    options: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Stored(Expression):
    """What the module stores by a name made from ``layer``: a parameter, or a buffer, of these ``values``.

    ``blobs`` are the learnable blobs that it is made from.
    """

    layer: str
    values: torch.Tensor
    learned: bool = True
    blobs: tuple[Any, ...] = ()

    def tensors(self, name: str) -> dict[str, torch.Tensor]:
        """Return the tensors of the state_dict of a module that has it as attribute ``name``."""
        return {name: self.values}

    def same_as(self, other: Stored | Submodule) -> bool:
        """Return whether it is the same parameter: one blob in one shape."""
        return isinstance(other, Stored) and _are(self.blobs, other.blobs) and self.values.shape == other.values.shape


@dataclass(frozen=True, eq=False)
class Submodule:
    """A submodule: its class and the arguments of its constructor, and its parameters and buffers by name."""

    layer: str
    cls: type[torch.nn.Module]
    args: tuple[Any, ...]
    options: Mapping[str, Any]
    state: Mapping[str, torch.Tensor] = field(repr=False)
    blobs: tuple[Any, ...] = ()

    def __call__(self, *args: Any) -> Call:
        """Return the call of its forward."""
        return call(self, *args)

    def tensors(self, name: str) -> dict[str, torch.Tensor]:
        """Return the tensors of the state_dict of a module that has it as attribute ``name``."""
        return {f"{name}.{role}": tensor for role, tensor in self.state.items()}

    def same_as(self, other: Stored | Submodule) -> bool:
        """Return whether it is the same module: of one class, with one configuration, of the same blobs as they lie."""
        return (
            isinstance(other, Submodule)
            and (self.cls, self.args, self.options) == (other.cls, other.args, other.options)
            and _are(self.blobs, other.blobs)
            and self.state.keys() == other.state.keys()
            and all(_same(tensor, other.state[role]) for role, tensor in self.state.items())
        )


def _are(blobs: tuple[Any, ...], others: tuple[Any, ...]) -> bool:
    return len(blobs) > 0 and len(blobs) == len(others) and all(a is b for a, b in zip(blobs, others, strict=True))


def _same(tensor: torch.Tensor, other: torch.Tensor) -> bool:
    """Return whether two tensors made from the same blobs are made in the same way; a transposed one is not."""
    return tensor.stride() == other.stride() and torch.equal(tensor, other)


def plain(function: Callable[..., Any], *attributes: str, **options: str) -> Callable[..., Call]:
    """Return the exporter of layers that are one call: of their bottoms, then of attributes, given by their names."""

    def write(layer: Any, code: Any, *bottoms: Expression) -> Call:
        named = {name: getattr(layer, attribute) for name, attribute in options.items()}
        return call(function, *bottoms, *(getattr(layer, name) for name in attributes), **named)

    return write


def call(function: Callable[..., Any], *args: Any, **options: Any) -> Call:
    """Return the call of a function."""
    return Call(function, args, options)


def with_axes(x: Expression, count: int) -> Expression:
    """Return a value with so many axes of size 1 appended."""
    return x[(..., *(None,) * count)] if count > 0 else x


def parts(expression: Any) -> Iterator[Any]:
    """Yield an expression and all its parts, in the order in which they are written."""
    yield expression
    inside: Iterable[Any] = ()
    if isinstance(expression, Call):
        inside = (expression.function, *expression.args, *expression.options.values())
    elif isinstance(expression, (tuple, list)):
        inside = expression
    elif isinstance(expression, slice):
        inside = (expression.start, expression.stop)
    for part in inside:
        yield from parts(part)


def evaluate(expression: Any, known: Mapping[Any, Any]) -> Any:
    """Return the value of an expression; ``known`` has those of values, TRAINING and what is stored."""
    if isinstance(expression, Call):
        function = known.get(expression.function, expression.function)
        options = {name: evaluate(value, known) for name, value in expression.options.items()}
        return function(*(evaluate(value, known) for value in expression.args), **options)
    if isinstance(expression, (tuple, list)):
        return type(expression)(evaluate(part, known) for part in expression)
    if isinstance(expression, slice):
        return slice(evaluate(expression.start, known), evaluate(expression.stop, known))
    return known[expression] if isinstance(expression, Expression) else expression
