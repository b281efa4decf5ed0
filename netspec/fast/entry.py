"""What is known of a class of layers that makes it faster: one entry for each class, in the files of layers/."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from netspec.fast.folding import Folds
from netspec.fast.kernels import Inference, Kernel, Learning
from netspec.run.recorded import Kernels


@dataclass(frozen=True)
class Entry:
    """What is faster than ``forward`` and autograd; each function gets a layer of the class, at its present shapes.

    ``inference`` returns the kernel of a run without gradients, ``learning`` those of one with them: None where
    ``forward``, and autograd, are as good. ``folds`` returns what the layer is to its neighbors. ``fresh`` says whether
    its one top is memory of its own, not a bottom's; ``any_layout``: its kernel, or ``forward``, takes bottoms whose
    channels lie side by side (channels_last).
    """

    inference: Callable[[Any, Inference], Kernel | None] = lambda layer, how: None
    learning: Callable[[Any, Learning], Kernels | None] = lambda layer, how: None
    folds: Callable[[Any], Folds] = lambda layer: Folds()
    fresh: bool | Callable[[Any], bool] = False
    any_layout: bool = False
