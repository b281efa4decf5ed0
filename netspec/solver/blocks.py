"""Packs the learnable blobs of a training into contiguous memory, so that one operation updates many of them.

An operation of torch takes as long for a bias of ten numbers as for ten thousand. So small blobs with the same
multipliers share one piece of memory, and so do their gradients and their history. Parameters become views of
that memory. Large blobs stay in place and are divided into blocks that fit into a CPU's cache. All of
Caffe's rules are elementwise, so the results do not change.
"""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from netspec.layers.contract.learned import Seen, values_of
from netspec.net.assembly import Learnable
from netspec.solver import update

LINE = 16  # numbers (64 bytes): each blob begins at a multiple of this


@dataclass(frozen=True)
class _Block:
    """A contiguous block of numbers, with its gradients and its history, one tensor per set."""

    weights: torch.Tensor
    diffs: torch.Tensor
    history: list[torch.Tensor]
    lr_mult: float
    decay_mult: float


class Blocks:
    """The parameters that a solver updates, and the history of each, in ``sets`` sets.

    On a CPU, the constructor moves the parameters in memory, so no aliases of them may exist yet.
    """

    def __init__(self, learnable: Sequence[Learnable], sets: int) -> None:
        self._learnable, self._sets = learnable, sets
        self._placed: list[torch.nn.Parameter] = []
        self._gradients: list[torch.Tensor] = []  # each piece of memory
        self._blocks: list[_Block] = []
        self._histories: dict[int, list[torch.Tensor]] = {}
        groups: dict[Any, list[int]] = {}
        if not all(item.parameter.device.type == "cpu" and item.parameter.is_contiguous() for item in learnable):
            self.history = [torch.zeros_like(values_of(item.parameter)) for _ in range(sets) for item in learnable]
            return
        for i, item in enumerate(learnable):
            blob = item.parameter
            if blob.numel() > update.BLOCK:
                self._keep(i)
            else:
                groups.setdefault((item.lr_mult, item.decay_mult, blob.dtype, blob.requires_grad), []).append(i)
        for indices in groups.values():
            self._put_together(indices)
        self.history = [self._histories[i][k] for k in range(sets) for i in range(len(learnable))]
        self._seen = Seen(self._placed)

    def _put_together(self, indices: Sequence[int]) -> None:
        """Pack blobs with the same multipliers into pieces of memory of at most ``BLOCK`` numbers."""
        piece: list[int] = []
        free = update.BLOCK
        for i in indices:
            size = _lines(self._learnable[i].parameter)
            if piece and size > free:
                self._move(piece)
                piece, free = [], update.BLOCK
            piece.append(i)
            free -= size
        self._move(piece)

    def _move(self, piece: Sequence[int]) -> None:
        first = self._learnable[piece[0]]
        size = sum(_lines(self._learnable[i].parameter) for i in piece)
        weights, diffs, *history = (torch.zeros(size, dtype=first.parameter.dtype) for _ in range(2 + self._sets))
        start = 0
        for i in piece:
            blob = self._learnable[i].parameter
            here, shape = slice(start, start + blob.numel()), blob.shape
            weights[here].copy_(values_of(blob).view(-1))
            blob.data = weights[here].view(shape)
            if blob.requires_grad:
                blob.grad = diffs[here].view(shape)
            self._placed.append(blob)
            self._histories[i] = [each[here].view(shape) for each in history]
            start += _lines(blob)
        self._gradients.append(diffs)
        self._blocks.append(_Block(weights, diffs, history, first.lr_mult, first.decay_mult))

    def _keep(self, i: int) -> None:
        """Divide a large blob, which stays in place, into blocks."""
        item = self._learnable[i]
        blob = item.parameter
        if blob.requires_grad:
            blob.grad = torch.zeros_like(blob)
        self._placed.append(blob)
        self._histories[i] = [torch.zeros_like(values_of(blob)) for _ in range(self._sets)]
        diffs = torch.zeros_like(values_of(blob)) if blob.grad is None else blob.grad
        self._gradients.append(diffs)
        flat = [each.view(-1).split(update.BLOCK) for each in (values_of(blob), diffs, *self._histories[i])]
        for weights, gradient, *history in zip(*flat, strict=True):
            self._blocks.append(_Block(weights, gradient, history, item.lr_mult, item.decay_mult))

    def _are_in_place(self) -> bool:
        """Return whether parameters and gradients are still in the packed memory."""
        return bool(self._blocks) and self._seen.are(self._placed)

    def clear(self) -> None:
        """Set all gradients to 0."""
        if self._are_in_place():
            for gradient in self._gradients:
                gradient.zero_()
        else:
            update.clear(item.parameter for item in self._learnable)

    def diffs(self) -> list[torch.Tensor]:
        """Return the gradient of each parameter, or zeros if it has none."""
        found = []
        for item in self._learnable:
            blob = item.parameter
            found.append(torch.zeros_like(values_of(blob)) if blob.grad is None else blob.grad)
        return found

    def pieces(self, rate: float, decay: float) -> Iterator[update.Piece]:
        """Yield the pieces that an iteration updates, with their rates and decays."""
        if self._are_in_place():
            for block in self._blocks:
                own = [rate * block.lr_mult], [decay * block.decay_mult]
                yield update.Piece([block.weights], [block.diffs], block.history, *own)
            return
        learnable = self._learnable
        rates, decays = [rate * item.lr_mult for item in learnable], [decay * item.decay_mult for item in learnable]
        weights = [values_of(item.parameter) for item in learnable]
        yield from update.cut(update.Piece(weights, self.diffs(), self.history, rates, decays))


def _lines(blob: torch.Tensor) -> int:
    """Return the size of a blob, rounded up to whole lines."""
    return -(-blob.numel() // LINE) * LINE
