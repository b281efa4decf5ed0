"""The registry of layers: from the type in a prototxt to the class."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

from netspec.errors import did_you_mean
from netspec.layers.contract.base import Layer
from netspec.layers.contract.data_layer import DataLayer
from netspec.proto.forks import forks
from netspec.proto.schema import LayerParameter

_LAYERS: dict[str, type[Layer]] = {}
L = TypeVar("L", bound=type[Layer])


def register(type_name: str, *reads: str) -> Callable[[L], L]:
    """Class decorator: register a layer under the type that prototxt files use.

    ``reads`` are the fields of LayerParameter that are the layer's own, e.g. ``"pooling_param"``; a net warns of all
    others (netspec/net/assembly.py).
    """

    module = calling_module()

    def add(cls: L) -> L:
        cls.type = type_name
        cls.reads = frozenset(reads)
        if not forks().adopt(cls, module):
            assert type_name not in _LAYERS, f"layer type {type_name} registered twice"
            _LAYERS[type_name] = cls
        return cls

    return add


def calling_module() -> str:
    """Return the name of the module that called the caller. A fork's module may register the classes of another."""
    return sys._getframe(2).f_globals["__name__"]


def registered(type_name: str) -> type[Layer] | None:
    """Return the class that Caffe, or the program, has for a type, or None."""
    return _LAYERS.get(type_name)


def layer_class(type_name: str) -> type[Layer] | None:
    """Return the class of a layer type: Caffe's, or that of the only fork or dialect that can be meant; or None."""
    return registered(type_name) or forks().class_of(LayerParameter(type=type_name))


def class_of(param: LayerParameter) -> type[Layer] | None:
    """Return the class of a layer by itself, or None: that of the fork that it shows, or else that of its type."""
    return forks().class_of(param) or registered(param.type)


def source_of(param: LayerParameter) -> str:
    """Return the path that a layer names for its records, "" where it names none, or is unknown."""
    cls = class_of(param)
    return cls.source_of(param) if cls and issubclass(cls, DataLayer) else ""


def layer_types() -> list[str]:
    """Return Caffe's types, and those of the dialects that a user added for every net, in alphabetical order."""
    types = forks().additions().types if forks().everywhere else {}
    return sorted({*_LAYERS, *(name for name, owners in types.items() if {*owners} & {*forks().everywhere})})


def unknown_type(type_name: str) -> str:
    """Return the message for an unknown type, with a similar type or the fork that defines it."""
    additions, new = forks().additions(), forks().new
    advice = additions.advise(type_name, additions.types.get(type_name, ()))
    close = did_you_mean(type_name, sorted({*layer_types(), *additions.types}), near=True) or ";"
    hint = f"; {advice}" if advice else f"{close} `netspec layers` lists the known ones{', ' * bool(new)}{new}"
    return f'unknown layer type "{type_name}"{hint}'
