"""How a layer is exported: as an expression of PyTorch (expression.py), from which its ONNX nodes are made too.

The expressions are in ``layers`` and ``dialects``, a function for each class of layers::

    @exports(Swish)
    def swish(layer: Any, code: TorchCode, x: Expression) -> Expression:
        return x * call(torch.sigmoid, layer.beta * x)

It gets the expressions of the bottoms and returns that of the top, or one for each top. It must compute the same as
``forward``, for every dynamic size, and so must its gradient. It reads attributes of the layer, and raises
:func:`refusal` for what it does not support. A layer outside netspec has it as a method, ``to_torch(self, code, x)``.

A helper that torch does not have stands at the end of the module, and is called like a function of torch; the exported
source gets a copy of it. It may use torch, F and other such helpers, and makes its tensors on the device of its
arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache, partial
from importlib import import_module
from typing import Any, TypeVar

import numpy as np

from netspec.errors import SpecError
from netspec.layers.contract.base import Layer

E = TypeVar("E", bound=Callable[..., Any])
EXPORTERS: dict[str, Callable[..., Any]] = {}  # by the path of the layer's class


def exports(*layers: type[Layer] | str) -> Callable[[E], E]:
    """Decorator: register the expression of classes of layers.

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
def _exporters() -> dict[str, Callable[..., Any]]:
    for package in ("layers", "dialects"):  # which import this module
        import_module(f"netspec.export.{package}")
    return EXPORTERS


def exporter_of(layer: Layer) -> Callable[..., Any]:
    """Return what writes a layer: a function of a TorchCode and of expressions of the bottoms.

    A subclass with its own ``forward`` does not inherit how its base class is exported. Raises SpecError if the layer
    cannot be exported.
    """
    cls, known = type(layer), _exporters()
    owner = next((one for one in cls.__mro__ if path_of(one) in known or "to_torch" in vars(one)), None)
    if owner is None or getattr(owner, "forward", None) not in (cls.forward, Layer.forward):
        raise refusal(layer, getattr(layer, "not_exported", "its class does not say how"))
    own: Any = layer
    return partial(known[path_of(owner)], layer) if path_of(owner) in known else own.to_torch


def refusal(layer: Layer, reason: str) -> SpecError:
    """Return the error for a layer that cannot be exported."""
    return layer.error(f"cannot be exported: {reason}")


def layer_notes(layers: Iterable[Layer]) -> list[str]:
    """Return what the user of an exported net must know of its layers, in lines."""
    lost = "starts at zero in every run; in Caffe it continues in the next run if cont is 1"
    recurrent: list[Any] = [layer for layer in layers if getattr(layer, "state_names", ()) and not layer.exposed]
    return [str(layer.error(f"its state ({', '.join(layer.state_names)}) {lost}")) for layer in recurrent]


def rounded(value: float) -> float:
    """Return a number of a float32 field as it was written: the shortest that float32 rounds to it."""
    return float(str(np.float32(value)))
