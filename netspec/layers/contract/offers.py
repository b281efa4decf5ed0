"""What a layer may offer in addition to its forward pass, each by an attribute that its class defines.

passes_on     whether every top is the bottom, unchanged
gradients.py  caffes_gradient: the gradient from the content of memory
joining.py    joined_with, joins_as: consecutive layers that one layer computes
reading.py    running_state, restart, and the like: records, and state that is kept between passes

:class:`netspec.layers.contract.base.Layer` has none of them. :func:`offered` returns one if a layer has it.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from netspec.layers.contract.base import Layer


@cache
def _has(cls: type[Layer], name: str) -> bool:
    """Return whether a class has an attribute that was defined for the forward pass of this class.

    A subclass that replaces ``forward`` does not inherit what its base class offers for the old one.
    """
    owner = next((each for each in cls.__mro__ if name in vars(each)), None)
    return owner is not None and getattr(owner, "forward", Layer.forward) in (cls.forward, Layer.forward)


def offered(layer: Layer, name: str) -> Any:
    """Return an attribute that belongs to a layer's forward pass, or None if its class has none."""
    return getattr(layer, name) if _has(type(layer), name) else None


def call(layer: Layer, name: str, *arguments: Any) -> Any:
    """Call an offered method and return its result, or None if the class has none."""
    method = offered(layer, name)
    return None if method is None else method(*arguments)


def passes_on(layer: Layer) -> bool:
    """Return whether every top of a layer is its bottom, unchanged, at its present settings."""
    return bool(offered(layer, "passes_on"))
