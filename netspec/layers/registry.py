"""The one registry: layer type, as a prototxt writes it, to class."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from netspec.errors import did_you_mean
from netspec.layers.base import Layer
from netspec.proto.dialect.files import announce_known
from netspec.proto.dialect.registry import advice_for, dialects_with_type

_LAYERS: dict[str, type[Layer]] = {}
L = TypeVar("L", bound=type[Layer])


def register(type_name: str, *reads: str, replaces: type[Layer] | None = None) -> Callable[[L], L]:
    """Class decorator: make a layer known under the type that prototxt files use.

    ``reads`` are the fields of LayerParameter that are the layer's own, e.g. ``"pooling_param"``, and what a dialect
    adds to them, e.g. ``"pooling_param.extra"``; a net warns of all others (netspec/net/ignored_fields.py). With
    ``replaces`` a dialect's subclass takes the place of the class that has the type, to honor such an addition.
    """

    def add(cls: L) -> L:
        assert _LAYERS.get(type_name) is replaces, f"layer type {type_name} registered twice"
        cls.type = type_name
        cls.reads = frozenset(reads)
        _LAYERS[type_name] = cls
        return cls

    return add


def layer_class(type_name: str) -> type[Layer] | None:
    """Return the class registered for a type, or None."""
    return _LAYERS.get(type_name)


def layer_types() -> list[str]:
    """Return all registered types, in alphabetical order."""
    return sorted(_LAYERS)


def unknown_type(type_name: str) -> str:
    """Return the sentence that says that a type is unknown, and what may be meant or which dialect has it."""
    announce_known()
    advice = advice_for(type_name, dialects_with_type(type_name))
    hint = f"; {advice}" if advice else did_you_mean(type_name, layer_types())
    return f'unknown layer type "{type_name}"{hint or "; `netspec layers` lists the known ones"}'
