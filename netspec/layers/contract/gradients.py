"""Layers that compute gradients from what is in memory at the time of the backward pass, as Caffe does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch

from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import offered

NOTHING: frozenset[str] = frozenset()


class OwnGradient(Protocol):
    """A layer of one bottom and top whose gradient reads memory: see netspec/run/eager.py."""

    gradient_reads: frozenset[str]  # of "bottom", "sign" (of it), "top", "kept" (the bottom of the forward pass)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """Return the bottom's gradient as Caffe computes it, step by step, from the data in memory at backward.

        A layer that works in place gets one tensor as its bottom and its top.
        """
        ...


class OwnGradients(Protocol):
    """A layer of several bottoms and one top whose gradient reads memory; it does not work in place."""

    gradient_reads: frozenset[str]  # "top"

    def caffes_gradients(
        self, bottoms: Sequence[torch.Tensor], top: torch.Tensor, diff: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return the bottoms' gradients as Caffe computes them from the data in memory at backward."""
        ...


class IgnoresPropagateDown(Protocol):
    """A layer that ignores ``propagate_down`` in its backward pass."""

    ignores_propagate_down: frozenset[int]  # the bottoms that get a gradient even where it is false


def gradient_reads(layer: Layer) -> frozenset[str]:
    """Return what a layer's gradient reads from memory; nothing if autograd keeps all that it needs."""
    return getattr(layer, "gradient_reads", NOTHING)


def ignores_propagate_down(layer: Layer) -> frozenset[int]:
    """Return the bottoms of a layer that get a gradient even where ``propagate_down`` is false."""
    return getattr(layer, "ignores_propagate_down", frozenset())


def gradients_from_memory(
    layer: Layer, bottoms: Sequence[torch.Tensor], top: torch.Tensor, diff: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Return the gradients of the bottoms of a layer that computes them from memory, as Caffe does."""
    if len(bottoms) > 1:
        return offered(layer, "caffes_gradients")(bottoms, top, diff)
    return (offered(layer, "caffes_gradient")(bottoms[0], top, diff),)
