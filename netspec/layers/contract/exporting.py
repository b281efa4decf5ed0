"""What netspec/export reads and calls to export a layer, with a writer of netspec/layers/contract/targets.py."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import ClassVar, Protocol

from netspec.errors import SpecError
from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import offered
from netspec.layers.contract.targets import OnnxGraph, TorchCode


class PassesOn(Protocol):
    """A layer that may do nothing at its present settings."""

    @property
    def passes_on(self) -> bool:
        """Whether every top is the bottom, unchanged."""
        ...


class Differs(Protocol):
    """A layer that computes something else when it is exported."""

    @property
    def export_note(self) -> str:
        """What is different, for the user; empty where nothing is."""
        ...


class Exported(Protocol):
    """A layer that can be exported: as one operator and one call, or by methods where it takes more.

    Where a class has both, the method counts. The exported form must compute the same as ``forward``, at every free
    size.
    """

    onnx_op: ClassVar[str]  # an ONNX operator, whose inputs are the bottoms
    onnx_attributes: ClassVar[Sequence[str]]  # the operator's attributes; the layer has them by the same names
    torch_call: ClassVar[str]  # an expression; {x}, {y}, {z} are bottoms, other names in braces the layer's attributes

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str | Sequence[str]:
        """Write the layer into an ONNX graph, given the values of its bottoms; return those of its tops."""
        ...

    def to_torch(self, code: TorchCode, *bottoms: str) -> str | Sequence[str]:
        """Write the layer as source for PyTorch, given the expressions of its bottoms; return those of its tops."""
        ...


def layer_notes(layers: Iterable[Layer]) -> list[str]:
    """Return what the user of an exported net must know of its layers, in lines."""
    return [str(layer.error(note)) for layer in layers if (note := offered(layer, "export_note"))]


def passes_on(layer: Layer) -> bool:
    """Return whether every top of a layer is its bottom, unchanged."""
    return bool(offered(layer, "passes_on"))


def refusal(layer: Layer, target: str, reason: str = "") -> SpecError:
    """Return the error for a layer that cannot be exported, with this reason or the one of its class."""
    reason = reason or getattr(layer, "not_exported", "its class does not support it")
    return layer.error(f"cannot be exported to {target}: {reason}")
