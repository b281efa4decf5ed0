"""What a net may be given to run faster. It changes nothing of what is computed; netspec/fast is one."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Protocol

import torch

from netspec.run.eager import Eager
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
