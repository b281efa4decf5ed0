"""The interface through which a net gets faster code. netspec/fast implements it. Results must not change."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any, Protocol

import torch

from netspec.layers.contract.base import Layer
from netspec.run.eager import Eager
from netspec.run.recorded import Diff, Kernels
from netspec.run.walk import Runner


class Trainer(Protocol):
    """Runs a net forward and backward.

    If ``keeps`` is set, ``passed`` contains the values of the last pass and their gradients, by value number.
    """

    keeps: bool
    passed: tuple[list[Any], list[Any]] | None

    def is_watched(self) -> bool:
        """Return whether a layer or blob has hooks, which only autograd calls."""
        ...

    def run(self) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run the net forward and backward. Return the weighted sum of its losses, a scalar, and the output blobs.

        The gradients of the learnable blobs are added to ``grad``. The loss is valid until the next call.
        """
        ...


class Speed(Protocol):
    """Makes faster runners and kernels for a net."""

    def prepared(self, eager: Eager, passes: Collection[str]) -> Runner:
        """Return a runner without gradients. ``passes`` are the allowed optimizations (netspec/graph/options.py)."""
        ...

    def trainer(self, eager: Eager, largest: float | None) -> Trainer | str:
        """Return a trainer for the net, or the reason why there is none.

        ``largest`` is the largest number of elements in all tops of a net that is trained this way; None: a default.
        """
        ...

    def reads_at_once(self, decode: Callable[[Any], Any]) -> Callable[[Sequence[bytes]], Any]:
        """Return a function that reads many raw Datums together. ``decode`` returns the array (C, H, W) of one Datum.

        See :class:`netspec.data.sources.DatabaseSource`.
        """
        ...

    def is_fresh(self, layer: Layer) -> bool:
        """Return whether the top of a prepared layer has its own memory, not that of a bottom."""
        ...

    def learns(self, layer: Layer) -> bool:
        """Return whether :meth:`kernels` returns kernels for a layer with its current shapes."""
        ...

    def kernels(self, layer: Layer, wanted: Sequence[bool], sums: Sequence[Diff]) -> Kernels | None:
        """Return the forward and backward kernels of a layer for its current shapes, or None.

        ``wanted[i]``: whether the gradient of bottom i is computed. ``sums[j]``: the tensor to which the gradient of
        learnable blob j is added. Bottoms may change between the calls, so the backward kernel reads them again.
        """
        ...
