"""Finds how a layer is exported: by the exporter of its class, or by attributes of the class itself."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

from netspec.errors import SpecError
from netspec.export import dialects as _dialects  # noqa: F401  registers exporters
from netspec.export import layers as _layers  # noqa: F401  registers exporters
from netspec.export.exporter import EXPORTERS, Exporter, path_of
from netspec.layers.contract.base import Layer


def exporter_class(layer: type[Layer]) -> type[Exporter] | None:
    """Return the exporter that is registered for exactly this class, or None."""
    return EXPORTERS.get(path_of(layer))


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
