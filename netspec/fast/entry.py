"""The kernels that make a class of layers faster: one entry for each class, in the files of layers/."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from netspec.fast.folding import Folds
from netspec.fast.kernels import Inference, Kernel, Learning
from netspec.run.recorded import Kernels


@dataclass(frozen=True)
class Entry:
    """Functions that make kernels for a class of layers. Each takes a layer of the class, at its present shapes.

    - ``inference`` returns the kernel for runs without gradients; None where ``forward`` is as fast.
    - ``learning`` returns the two kernels for training; None where ``forward`` and autograd are as fast.
    - ``folds`` returns how the layer can be joined with its neighbors.
    - ``fresh``: whether its single top has memory of its own, not that of a bottom.
    - ``any_layout``: whether the kernel, or ``forward`` if there is none, also takes bottoms in channels_last.
    """

    inference: Callable[[Any, Inference], Kernel | None] = lambda layer, how: None
    learning: Callable[[Any, Learning], Kernels | None] = lambda layer, how: None
    folds: Callable[[Any], Folds] = lambda layer: Folds()
    fresh: bool | Callable[[Any], bool] = False
    any_layout: bool = False
