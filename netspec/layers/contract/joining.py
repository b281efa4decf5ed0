"""Layers in a row that one of them does in one: netspec/run/parts.py asks where a net learns."""

from __future__ import annotations

from typing import Protocol

from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import call


class Joins(Protocol):
    """A layer that may do the work of those after it as well."""

    def joined_with(self, after: Layer) -> Layer | None:
        """Return a layer that does the work of this one and then of another, with the blobs of both; or None."""
        ...


class Joined(Protocol):
    """A layer whose work another may do."""

    @property
    def joins_as(self) -> str:
        """What it is to a layer before it: "relu", max(x, 0); "scale", learned factors and biases of the channels."""
        ...


def joined(first: Layer, after: Layer) -> Layer | None:
    """Return the layer that does the work of both, None where nothing does."""
    return call(first, "joined_with", after)
