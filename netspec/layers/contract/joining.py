"""Consecutive layers that one layer can compute together. Trainings use it (netspec/run/parts.py)."""

from __future__ import annotations

from typing import Protocol

from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import call


class Joins(Protocol):
    """A layer that can also do the work of layers after it."""

    def joined_with(self, after: Layer) -> Layer | None:
        """Return a layer that does the work of this layer and of ``after``, with the blobs of both; or None."""
        ...


class Joined(Protocol):
    """A layer that the layer before it may be able to compute."""

    @property
    def joins_as(self) -> str:
        """What the layer computes: "relu" (max(x, 0)), "scale" (learned factors and biases of channels) or ""."""
        ...


def joined(first: Layer, after: Layer) -> Layer | None:
    """Return a layer that does the work of both, or None."""
    return call(first, "joined_with", after)
