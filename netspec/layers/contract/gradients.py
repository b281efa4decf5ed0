"""Layers that compute their gradients like Caffe: from the data in memory when the backward pass runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch

from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import offered

NOTHING: frozenset[str] = frozenset()


class OwnGradient(Protocol):
    """A layer with one bottom and one top that computes its gradient from memory: see netspec/run/eager.py."""

    gradient_reads: frozenset[str]  # of "bottom", "sign" (of it), "top", "kept" (the bottom of the forward pass)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """Return the bottom's gradient with Caffe's steps, from the data in memory at the backward pass.

        A layer that works in place gets the same tensor as its bottom and its top.
        """
        ...


class OwnGradients(Protocol):
    """A layer with several bottoms and one top that computes its gradients from memory. It is never in place."""

    gradient_reads: frozenset[str]  # "top"

    def caffes_gradients(
        self, bottoms: Sequence[torch.Tensor], top: torch.Tensor, diff: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return the bottoms' gradients with Caffe's steps, from the data in memory at the backward pass."""
        ...


class IgnoresPropagateDown(Protocol):
    """A layer that ignores ``propagate_down`` in its backward pass."""

    ignores_propagate_down: frozenset[int]  # the bottoms that get a gradient even where it is false


def gradient_reads(layer: Layer) -> frozenset[str]:
    """Return what a layer's gradient reads from memory; an empty set if autograd saves all that it needs."""
    return getattr(layer, "gradient_reads", NOTHING)


def ignores_propagate_down(layer: Layer) -> frozenset[int]:
    """Return the bottoms of a layer that get a gradient even where ``propagate_down`` is false."""
    return getattr(layer, "ignores_propagate_down", frozenset())


def gradients_from_memory(
    layer: Layer, bottoms: Sequence[torch.Tensor], top: torch.Tensor, diff: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Return the gradients of the bottoms of a layer that computes them from memory, as Caffe does.

    A later layer in place may have given the memory of the top other axes: MVN makes four.
    """
    bottoms = [top.view(diff.shape) if bottom is top else bottom for bottom in bottoms]
    top = top.view(diff.shape)
    if len(bottoms) > 1:
        return offered(layer, "caffes_gradients")(bottoms, top, diff)
    return (offered(layer, "caffes_gradient")(bottoms[0], top, diff),)
