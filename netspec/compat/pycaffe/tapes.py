"""What :class:`netspec.compat.pycaffe.steps.LayerStep` keeps of the runs of its layer, and the memory of tensors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import Seen
from netspec.layers.utility.live_blobs import Blob, BlobVec, Memory, Shape, write
from netspec.run.recorded import Kernels


@dataclass(frozen=True)
class Tape:
    """The record of one run of a layer, for its backward pass.

    - ``leaves``: the inputs. With autograd they are copies, with kernels the tensors themselves.
    - ``holders``: tensors that keep the memory of the inputs alive.
    - ``tops``: the outputs.
    - ``backward``: the function that computes the gradients.
    """

    leaves: list[torch.Tensor]
    holders: list[torch.Tensor]
    tops: Sequence[torch.Tensor]
    backward: Callable[..., Any]


@dataclass(frozen=True)
class LayerKernels:
    """The training kernels of a layer for bottoms of these shapes, and the state of the blobs they were made for.

    ``learn[j]`` says whether the gradient of blob j is computed.
    """

    shapes: list[tuple[int, ...]]
    learn: list[bool]
    seen: Seen
    kernels: Kernels


def by_autograd(
    leaves: Sequence[torch.Tensor], tops: Sequence[torch.Tensor], *diffs: torch.Tensor
) -> list[torch.Tensor | None]:
    """Return the gradients of a layer's inputs by autograd, from the gradients of its outputs."""
    ends = [(top, diff) for top, diff in zip(tops, diffs, strict=True) if top.requires_grad]
    if ends:
        torch.autograd.backward([top for top, _ in ends], [diff for _, diff in ends], retain_graph=True)
    found = [leaf.grad for leaf in leaves]
    for leaf in leaves:
        leaf.grad = None
    return found


@contextmanager
def undisturbed(layer: Layer) -> Iterator[None]:
    """A block in which a layer runs without lasting effects on its blobs, its state, or random numbers."""
    blobs, remembered = [blob.detach().clone() for blob in layer.blobs], dict(vars(layer))
    with layer.context.random.undisturbed():
        try:
            yield
        finally:
            vars(layer).update(remembered)
            with torch.no_grad():
                for blob, before in zip(layer.blobs, blobs, strict=True):
                    blob.copy_(before)


def storages(tensors: Sequence[torch.Tensor]) -> set[int]:
    """Return the addresses of tensors in main memory. (Views of tensors on a GPU show a copy.)"""
    return {tensor.untyped_storage().data_ptr() for tensor in tensors if tensor.device.type == "cpu"}


def not_shared(tensor: torch.Tensor, taken: set[int]) -> torch.Tensor:
    """Return the tensor, or a copy of it if its memory is in ``taken``."""
    aliased = tensor.device.type == "cpu" and tensor.untyped_storage().data_ptr() in taken
    return tensor.clone() if aliased else tensor


class BorrowedMemory(Memory):
    """The memory of a tensor that a net or a solver owns: a learnable blob's values, or their gradient.

    ``find`` returns the tensor. On a GPU views show a copy, which :meth:`upload` copies back.
    """

    def __init__(self, find: Callable[[], torch.Tensor], capacity: int) -> None:
        super().__init__()
        self.capacity = capacity
        self._find = find
        self._copy: torch.Tensor | None = None
        self._written = False

    @override
    def reserve(self, count: int) -> None:
        """Refuse more numbers than there are."""
        if count > self.capacity:
            raise ValueError(f"this blob has {self.capacity} numbers and cannot be reshaped to {count}")

    @override
    def view(self, shape: Shape) -> np.ndarray:
        tensor = self._find().detach()
        if tensor.device.type != "cpu":
            if self._copy is None:
                self._copy = torch.empty(tensor.shape, dtype=tensor.dtype)
            if not self._written:
                self._copy.copy_(tensor)
            tensor, self._written = self._copy, True
        return tensor.view(-1).numpy()[: math.prod(shape)].reshape(shape)

    @override
    def tensor(self, shape: Shape) -> torch.Tensor:
        return self._find().detach().view(-1)[: math.prod(shape)].view(shape)

    @override
    def put(self, tensor: torch.Tensor) -> None:
        """Write to the tensor."""
        write(self._find().detach().view(-1), tensor)

    @torch.no_grad()
    def upload(self) -> None:
        """Copy to the GPU what was written to views."""
        if self._written and self._copy is not None:
            self._find().detach().copy_(self._copy)
        self._written = False


def parameters(layer: Layer) -> BlobVec:
    """Return a layer's learnable blobs, as views of its parameters and of their gradients."""
    made = BlobVec()
    for j, shape in enumerate(layer.blob_shapes):
        count = layer.blobs[j].numel()
        data = BorrowedMemory(lambda j=j: layer.blobs[j], count)
        made.append(Blob(shape, data, BorrowedMemory(lambda j=j: gradient_of(layer.blobs[j]), count)))
    return made


def gradient_of(parameter: torch.Tensor) -> torch.Tensor:
    """Return the gradient of a parameter. Passes add to it, and never replace it."""
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
    return parameter.grad
