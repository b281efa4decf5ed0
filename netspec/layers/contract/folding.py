"""How one layer does the work of others, once weights stay as they are: netspec/run/fold.py puts the parts together."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import values_of
from netspec.layers.contract.offers import call, offered

Affine = tuple[torch.Tensor, torch.Tensor]  # scale and shift of each channel, (C,) in double: y = scale x + shift


@dataclass(frozen=True)
class Absorbed:
    """A layer that also does what another did: its LayerParameter and its learned blobs."""

    param: Any
    blobs: tuple[torch.Tensor, ...]


class Folds(Protocol):
    """What a layer can offer to those who fold a net; any part of it may be missing."""

    passes_on: bool  # whether every top is the bottom, unchanged
    absorbs: bool  # whether it can absorb, at its present settings, after its own work
    absorbs_before: bool  # likewise, before it

    def join(self, after: Layer) -> Layer | None:
        """Return a layer that does the work of this one and then of another, whose blobs it reads in each run.

        None where there is nothing faster than one after the other. Whoever makes its kernels gives it the sums of the
        blobs of both.
        """
        ...

    def as_affine(self) -> Affine | None:
        """Return the map that scales and shifts the channels, axis 1, of its bottom, None where it is another."""
        ...

    def absorb(self, scale: torch.Tensor, shift: torch.Tensor) -> Absorbed:
        """Return the layer that scales and shifts the channels of its top as well; in their precision."""
        ...

    def absorb_before(self, scale: torch.Tensor, shift: torch.Tensor) -> Absorbed:
        """Return the layer that scales and shifts the channels of its bottom before its own work."""
        ...


def as_affine(layer: Layer) -> Affine | None:
    """Return the map that a layer is, if it only scales and shifts the channels of its bottom."""
    return call(layer, "as_affine")


def joined_with(layer: Layer, after: Layer) -> Layer | None:
    """Return a layer that does the work of both, if the first offers one."""
    return call(layer, "join", after)


def passes_on(layer: Layer) -> bool:
    """Return whether every top of a layer is its bottom, unchanged."""
    return bool(offered(layer, "passes_on"))


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
    """Return a learned blob with the precision of another tensor, on its device."""
    return values_of(layer.blob(index)).to(other)


def copy_of(param: Any) -> Any:
    """Return a copy of a LayerParameter."""
    copy = type(param)()
    copy.CopyFrom(param)
    return copy
