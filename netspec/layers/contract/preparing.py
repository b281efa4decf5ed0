"""How a layer is made ready to be run many times at fixed shapes, without gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import torch
import torch.nn.functional as F

from netspec.exact.bound import BoundColumns, BoundVectors
from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import call

Kernel = Callable[..., Any]  # bottoms to a top, or to a tuple of tops


@dataclass(frozen=True)
class Finish:
    """A map from number to number, known by its name; ``change`` does it to its argument in place, and returns it."""

    name: str
    change: Callable[[torch.Tensor], torch.Tensor] = field(compare=False)


RELU = Finish("relu", F.relu_)  # whose gradient does not read what it overwrites


@dataclass(frozen=True)
class Preparation:
    """What a layer may know when it prepares for many passes at its present shapes, without gradients.

    ``finish`` is to be done in place to its top; its first bottom may be overwritten where ``reuse``. What it makes of
    its blobs for all shapes it gets by ``memo(name, make)``, which makes it once; weights may be laid out for a kernel
    where ``pack``. Its top may be memory that its next pass overwrites, unless it ``lasts``. ``keeps`` is told
    the bytes of what it keeps for its present shapes.
    """

    finish: Finish | None = None
    reuse: bool = False
    lasts: bool = True
    memo: Callable[[str, Callable[[], Any]], Any] = lambda _, make: make()
    pack: bool = True
    keeps: Callable[[int], None] = lambda _: None


class Prepares(Protocol):
    """What a layer can offer to those who run it without gradients; any part of it may be missing."""

    fresh: bool  # its one top is memory of its own, not a bottom's
    any_layout: bool  # its kernel takes bottoms whose channels lie side by side (channels_last)

    def prepare(self, how: Preparation) -> Kernel | None:
        """Return what computes ``forward`` and then ``how.finish``, for bottoms of the present shapes.

        Only this kernel uses the layer from now on, at these shapes. It may keep the blobs in another form, copied:
        after a write to them the layer is prepared again. No kernel may keep an alias of them. None: there is nothing
        better at these shapes.
        """
        ...

    def finishing(self) -> Finish | None:
        """Return the map from number to number that the layer is, None where no function does it in place."""
        ...

    def run_with(self, following: Sequence[Layer], *bottoms: torch.Tensor) -> tuple[int, tuple[torch.Tensor, ...]]:
        """Run this layer and, where one kernel does their work too, some of those that follow.

        Each of ``following`` has one bottom, the top of the layer before it, which nobody else reads. Returns how many
        of them were run, and the tops of the last.
        """
        ...

    def channel_factors(self) -> tuple[torch.Tensor, torch.Tensor | None] | None:
        """Return the factors of channels, axis 1, and the biases added then, None where it does something else."""
        ...


def own_kernel(layer: Layer, how: Preparation) -> Kernel | None:
    """Return the kernel that a layer has for its present shapes, None where it has none of its own."""
    return call(layer, "prepare", how)


def finishing(layer: Layer) -> Finish | None:
    """Return the map from number to number that a layer is, where it can be done in place."""
    return call(layer, "finishing")


def channel_factors(layer: Layer) -> tuple[torch.Tensor, torch.Tensor | None] | None:
    """Return the learned factors and biases of channels, where to multiply and add them is all that a layer does."""
    return call(layer, "channel_factors")


def finished(kernel: Kernel, finish: Finish | None) -> Kernel:
    """Return a kernel of one top followed by what changes it in place."""
    if finish is None:
        return kernel
    change = finish.change

    def both(*bottoms: torch.Tensor) -> torch.Tensor:
        top = kernel(*bottoms)
        return change(top[0] if isinstance(top, tuple) else top)

    return both


def copies(blobs: Sequence[torch.Tensor], how: Preparation) -> list[torch.Tensor]:
    """Return copies of a layer's blobs, the same ones for all shapes."""
    copy = partial(torch.clone, memory_format=torch.contiguous_format)
    return [how.memo(f"copy {i}", partial(copy, blob)) for i, blob in enumerate(blobs)]


def lent(bound: BoundVectors | BoundColumns, how: Preparation) -> Kernel:
    """Return the whole kernel of a layer of one top, whose memory its next pass uses again."""
    how.keeps(bound.nbytes)
    kernel = finished(bound.forward, how.finish)
    return (lambda *bottoms: kernel(*bottoms).clone()) if how.lasts else kernel
