"""Copies of the training net on other devices, which run their share of the records.

An iteration uses batch_size records per device, and the gradient is the mean over the devices of this and other
processes. Each process makes the same update of its own weights, and copies its root's weights to its replicas.
Each device has its own BatchNorm statistics during a run; those of the root are tested and saved.

Caffe: src/caffe/parallel.cpp (NCCL: all-reduce of the gradients, scaled by 1 / solver_count)
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from netspec.net.net import Net
from netspec.solver import update
from netspec.solver.precision import LossScale, computing
from netspec.solver.processes import Processes


class Replicas:
    """The training nets other than the root: those of this process, and the nets of the other ``processes``."""

    def __init__(self, root: Net, nets: Sequence[Net], processes: Processes) -> None:
        self._root, self.nets, self._processes = root, nets, processes

    def begin(self) -> None:
        """Copy the root's parameters, including BatchNorm's statistics, to every replica in all processes."""
        if self._processes.count > 1:
            self._processes.copy_root(item.parameter.detach() for item in self._root.learnable)
        self._copy(everything=True)

    def backward(self, precision: str, scale: LossScale) -> None:
        """Add the gradients of one pass, scaled, to each replica's own. The devices run in parallel."""
        losses = []
        for net in self.nets:
            with computing(precision, net.device):
                losses.append(net.forward_loss()[0])
        for loss in losses:
            if loss.requires_grad:
                scale.of(loss).backward()

    def reduce(self) -> None:
        """Make the root's gradients the mean over all devices of all processes."""
        count = self._processes.count * (1 + len(self.nets))
        if count > 1:
            self._reduce(count)

    @torch.no_grad()
    def _reduce(self, count: int) -> None:
        sums = []
        for own, *theirs in zip(*(net.learnable for net in (self._root, *self.nets)), strict=True):
            if own.parameter.grad is None:
                continue
            for learnable in theirs:
                own.parameter.grad += learnable.parameter.grad.to(own.parameter.device, non_blocking=True)
            sums.append(own.parameter.grad)
        self._processes.sum(sums)
        for gradient in sums:
            gradient /= count

    def clear(self) -> None:
        """Clear the gradients of the last iteration."""
        for net in self.nets:
            update.clear(item.parameter for item in net.learnable)

    def update(self) -> None:
        """Copy the root's learned weights to every replica."""
        self._copy(everything=False)

    def restart_data(self) -> None:
        """Restart every replica at its first record."""
        for net in self.nets:
            net.restart_data()

    def close(self) -> None:
        """Close files and stop threads."""
        for net in self.nets:
            net.close()

    def _copy(self, everything: bool) -> None:
        for net in self.nets:
            with torch.no_grad():
                for own, theirs in zip(self._root.learnable, net.learnable, strict=True):
                    if everything or own.lr_mult:
                        theirs.parameter.copy_(own.parameter, non_blocking=True)
