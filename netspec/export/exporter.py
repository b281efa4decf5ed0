"""How a layer is exported: by the exporter of its class, or by attributes of the class itself.

The exporters are in ``layers`` and ``dialects``, a module for each module of netspec that has layers. One says what the
layer computes in PyTorch, as an expression (expression.py), and in ONNX, as nodes of a graph (formats/onnx.py)::

    @exports(Swish)
    class SwishExport(Exporter):
        def to_torch(self, code: TorchCode, x: Expression) -> Expression:
            return x * call(torch.sigmoid, self.layer.beta * x)

        def to_onnx(self, graph: OnnxGraph, x: str) -> str:
            gate = graph.node("Sigmoid", graph.node("Mul", x, graph.constant(self.layer.beta)))
            return graph.node("Mul", x, gate)

A function that torch does not have stands at the end of the module, and is called like one; the exported source gets a
copy of it. It may use torch, F and other such functions, and makes its tensors on the device of its arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib import import_module
from typing import Any, ClassVar, TypeVar

import numpy as np

from netspec.errors import SpecError
from netspec.export.expression import Plain
from netspec.layers.contract.base import Layer

E = TypeVar("E", bound="type[Exporter]")
EXPORTERS: dict[str, type[Exporter]] = {}  # by the path of the layer's class


class Exporter:
    """Base of exporters: a layer's form in ONNX and in PyTorch, as one operator and one call, or as methods.

    If a class has both, the method is used. The exported form must compute the same as ``forward``, for every dynamic
    size. The methods are those of a layer outside netspec too::

        def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str | Sequence[str]
        def to_torch(self, code: TorchCode, *bottoms: Expression) -> Expression | Sequence[Expression]

    ``to_onnx`` writes the layer into an ONNX graph and returns the values of its tops; ``bottoms`` are the values of
    its bottoms. ``to_torch`` does the same with expressions. Both raise SpecError for what they do not support.
    """

    onnx_op: ClassVar[str]  # an ONNX operator, whose inputs are the bottoms
    onnx_attributes: ClassVar[Sequence[str]]  # the operator's attributes; the layer has them by the same names
    torch_call: ClassVar[Plain]  # a function of torch, and the attributes of the layer that it takes
    not_exported: ClassVar[str]  # why the layer cannot be exported

    def __init__(self, layer: Any) -> None:
        self.layer = layer

    def refusal(self, target: str, reason: str = "") -> SpecError:
        """Return the error for a layer that cannot be exported, with this reason or the one of its class."""
        reason = reason or getattr(self, "not_exported", "")
        return self.layer.error(f"cannot be exported to {target}: {reason or 'its class does not support it'}")


def exports(*layers: type[Layer] | str) -> Callable[[E], E]:
    """Class decorator: register an exporter for classes of layers.

    Classes of dialects are given by their paths, because a dialect may be imported only if a net uses it.
    """

    def add(exporter: E) -> E:
        EXPORTERS.update({layer if isinstance(layer, str) else path_of(layer): exporter for layer in layers})
        return exporter

    return add


def path_of(layer: type[Layer]) -> str:
    """Return the path of a class, ``"netspec.layers.common.Dropout"``."""
    return f"{layer.__module__}.{layer.__qualname__}"


@cache
def _exporters() -> dict[str, type[Exporter]]:
    for package in ("layers", "dialects"):  # which import this module
        import_module(f"netspec.export.{package}")
    return EXPORTERS


def exporter_class(layer: type[Layer]) -> type[Exporter] | None:
    """Return the exporter that is registered for exactly this class, or None."""
    return _exporters().get(path_of(layer))


@cache
def _owner(cls: type[Layer], name: str) -> type[Layer] | None:
    """Return the class of layers that has an attribute, by its exporter or itself, for the ``forward`` of ``cls``.

    A subclass with its own ``forward`` does not inherit how its base class is exported.
    """
    owner = next((one for one in cls.__mro__ if hasattr(exporter_class(one), name) or name in vars(one)), None)
    return owner if owner is not None and getattr(owner, "forward", None) in (cls.forward, Layer.forward) else None


def exported(layer: Layer, name: str) -> Any:
    """Return an attribute of a layer's exporter, or of the layer itself; None if neither has it."""
    owner = _owner(type(layer), name)
    if owner is None:
        return None
    exporter = exporter_class(owner)
    return getattr(exporter(layer) if exporter is not None and hasattr(exporter, name) else layer, name)


def layer_notes(layers: Iterable[Layer]) -> list[str]:
    """Return what the user of an exported net must know of its layers, in lines."""
    return [str(layer.error(note)) for layer in layers if (note := exported(layer, "export_note"))]


def refusal(layer: Layer, target: str) -> SpecError:
    """Return the error for a layer that cannot be exported, with the reason of its class or of a base class."""
    reasons = (getattr(each, "not_exported", "") for cls in type(layer).__mro__ for each in (cls, exporter_class(cls)))
    return Exporter(layer).refusal(target, next(filter(None, reasons), ""))


def rounded(value: float) -> float:
    """Return a number of a float32 field as it was written: the shortest that float32 rounds to it."""
    return float(str(np.float32(value)))
