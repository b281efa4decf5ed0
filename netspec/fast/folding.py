"""Types that describe how a layer can be joined with its neighbors. fold.py says how scales and shifts are folded."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from netspec.fast.kernels import Activation
from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import values_of

Affine = tuple[torch.Tensor, torch.Tensor]  # scale and shift of each channel, (C,) in double: y = scale x + shift


@dataclass(frozen=True)
class Absorbed:
    """The LayerParameter and the learned blobs of a layer that also scales and shifts channels."""

    param: Any
    blobs: tuple[torch.Tensor, ...]


Absorb = Callable[[torch.Tensor, torch.Tensor], Absorbed]  # takes a scale and a shift; the blobs get their precision


@dataclass(frozen=True)
class Folds:
    """How a layer can be joined with its neighbors, at its present settings.

    - ``activation``: the layer only computes this elementwise function.
    - ``affine``: returns the scale and shift of the channels (axis 1), if the layer does nothing else.
    - ``absorb``: returns a layer that also scales and shifts the channels of its top.
    - ``absorb_before``: returns a layer that first scales and shifts the channels of its bottom.
    """

    activation: Activation | None = None
    affine: Callable[[], Affine] | None = None
    absorb: Absorb | None = None
    absorb_before: Absorb | None = None


def absorbing(layer: Layer, absorbed: Absorbed) -> Layer:
    """Return a copy of a layer with this LayerParameter and these blobs, at its present shapes."""
    made = copy.copy(layer)
    made.param = absorbed.param
    blobs = torch.nn.ParameterList([torch.nn.Parameter(blob, False) for blob in absorbed.blobs])
    made._modules = {**layer._modules, "blobs": blobs}
    made.blob_shapes = [tuple(blob.shape) for blob in absorbed.blobs]
    return made


def blob_in_double(layer: Layer, index: int) -> torch.Tensor:
    """Return a copy of a learned blob in double precision, on the CPU."""
    return values_of(layer.blob(index)).cpu().double()


def blob_like(layer: Layer, index: int, other: torch.Tensor) -> torch.Tensor:
    """Return a learned blob with the precision and on the device of ``other``."""
    return values_of(layer.blob(index)).to(other)


def copy_of(param: Any) -> Any:
    """Return a copy of a LayerParameter."""
    copy = type(param)()
    copy.CopyFrom(param)
    return copy
