"""What a net may be given to run faster. It changes nothing of what is computed; netspec/fast is one."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any, Protocol

import torch

from netspec.layers.contract.base import Layer
from netspec.run.eager import Eager
from netspec.run.recorded import Diff, Kernels
from netspec.run.walk import Runner


class Trainer(Protocol):
    """Forward and backward passes of a net that trains, in one.

    Where it ``keeps``, ``passed`` has the values of the last pass and their gradients, by value number, until the next.
    """

    keeps: bool
    passed: tuple[list[Any], list[Any]] | None

    def is_watched(self) -> bool:
        """Return whether hooks wait for autograd's passes, so that it must make them."""
        ...

    def run(self) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run the net forward and backward; return the weighted sum of its losses, and the outputs.

        The gradients of the learnable blobs are added to ``grad``. The loss is valid until the next call.
        """
        ...


class Speed(Protocol):
    """Makes faster runners from the one that every net has."""

    def prepared(self, eager: Eager, passes: Collection[str]) -> Runner:
        """Return a runner of passes without gradients; ``passes`` are what it may do (netspec/graph/options.py)."""
        ...

    def trainer(self, eager: Eager, largest: float | None) -> Trainer | str:
        """Return what trains the net, or the reason, in words, why it has nothing for it.

        ``largest`` is the size, in numbers in all tops, of the nets that it trains; None for its own limit.
        """
        ...

    def reads_at_once(self, decode: Callable[[Any], Any]) -> Callable[[Sequence[bytes]], Any]:
        """Return what reads many raw Datums at once; ``decode`` returns the numbers (C, H, W) of one.

        See :class:`netspec.data.sources.DatabaseSource`.
        """
        ...

    def is_fresh(self, layer: Layer) -> bool:
        """Return whether the top of a prepared layer is memory of its own, not a bottom's."""
        ...

    def learns(self, layer: Layer) -> bool:
        """Return whether :meth:`kernels` has something for a layer at its present shapes."""
        ...

    def kernels(self, layer: Layer, wanted: Sequence[bool], sums: Sequence[Diff]) -> Kernels | None:
        """Return what runs a layer forward and backward at its present shapes, for those who run layers one by one.

        ``wanted[i]`` says whether bottom i's gradient is asked for, that of learnable blob j is added to ``sums[j]``.
        The backward kernel reads the bottoms again: they may have changed.
        """
        ...
