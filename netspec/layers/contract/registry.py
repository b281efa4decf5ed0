"""The registry of layers: from the type in a prototxt to the class."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from netspec.errors import did_you_mean
from netspec.graph.options import BuildOptions
from netspec.layers.contract.base import Layer
from netspec.proto.forks import forks
from netspec.proto.schema import LayerParameter

_LAYERS: dict[str, type[Layer]] = {}
L = TypeVar("L", bound=type[Layer])


def register(type_name: str, *reads: str) -> Callable[[L], L]:
    """Class decorator: register a layer under the type that prototxt files use.

    ``reads`` are the fields of LayerParameter that are the layer's own, e.g. ``"pooling_param"``; a net warns of all
    others (netspec/net/assembly.py).
    """

    def add(cls: L) -> L:
        assert type_name not in _LAYERS, f"layer type {type_name} registered twice"
        cls.type = type_name
        cls.reads = frozenset(reads)
        _LAYERS[type_name] = cls
        return cls

    return add


def registered(type_name: str) -> type[Layer] | None:
    """Return the class registered for a type so far, or None."""
    return _LAYERS.get(type_name)


def layer_class(type_name: str) -> type[Layer] | None:
    """Return the class of a layer type, or None. If one known fork defines the type, it is registered first."""
    if type_name not in _LAYERS:
        forks().register_type(type_name)
    return _LAYERS.get(type_name)


def class_of(param: LayerParameter, options: BuildOptions | None = None) -> type[Layer] | None:
    """Return the class of a layer, or None: that of ``options.dialects`` for it, or else that of its type."""
    return forks().class_of(param, options) or layer_class(param.type)


def source_of(param: LayerParameter) -> str:
    """Return the path that a layer names for its records, "" where it names none, or is unknown."""
    cls = class_of(param)
    return cls.source_of(param) if cls else ""


def layer_types() -> list[str]:
    """Return all registered types, in alphabetical order."""
    return sorted(_LAYERS)


def unknown_type(type_name: str) -> str:
    """Return the message for an unknown type, with a similar type or the fork that defines it."""
    known = forks()
    advice = known.advice(type_name, known.with_type(type_name))
    close = did_you_mean(type_name, sorted({*layer_types(), *known.layer_types()}), near=True) or ";"
    new = f", {known.new_layer}" if known.new_layer else ""
    hint = f"; {advice}" if advice else f"{close} `netspec layers` lists the known ones{new}"
    return f'unknown layer type "{type_name}"{hint}'
