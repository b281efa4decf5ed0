"""The base class of exporters: how a layer is written in another form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeVar

from netspec.errors import SpecError
from netspec.layers.contract.base import Layer

E = TypeVar("E", bound="type[Exporter]")
EXPORTERS: dict[str, type[Exporter]] = {}  # by the path of the layer's class


class Exporter:
    """Base of exporters: a layer's form in ONNX and in PyTorch, as one operator and one call, or as methods.

    If a class has both, the method is used. The exported form must compute the same as ``forward``, for every dynamic
    size. The methods are those of a layer outside netspec too::

        def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str | Sequence[str]
        def to_torch(self, code: TorchCode, *bottoms: str) -> str | Sequence[str]

    ``to_onnx`` writes the layer into an ONNX graph and returns the values of its tops; ``bottoms`` are the values of
    its bottoms. ``to_torch`` does the same with expressions of PyTorch code. Both raise SpecError for what they do not
    support.
    """

    onnx_op: ClassVar[str]  # an ONNX operator, whose inputs are the bottoms
    onnx_attributes: ClassVar[Sequence[str]]  # the operator's attributes; the layer has them by the same names
    torch_call: ClassVar[str]  # an expression; {x}, {y}, {z} are bottoms, other names in braces the layer's attributes
    not_exported: ClassVar[str]  # why the layer cannot be exported

    def __init__(self, layer: Any) -> None:
        self.layer = layer

    def refusal(self, target: str, reason: str = "") -> SpecError:
        """Return the error for a layer that cannot be exported, with this reason or the one of its class."""
        reason = reason or getattr(self, "not_exported", "")
        return self.layer.error(f"cannot be exported to {target}: {reason or 'its class does not support it'}")


def path_of(layer: type[Layer]) -> str:
    """Return the path of a class, ``"netspec.layers.common.Dropout"``."""
    return f"{layer.__module__}.{layer.__qualname__}"


def exports(*layers: type[Layer] | str) -> Callable[[E], E]:
    """Class decorator: register an exporter for classes of layers.

    Classes of dialects are given by their paths, because a dialect may be imported only if a net uses it.
    """

    def add(exporter: E) -> E:
        EXPORTERS.update({layer if isinstance(layer, str) else path_of(layer): exporter for layer in layers})
        return exporter

    return add
