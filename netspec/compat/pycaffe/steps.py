"""One layer of a net, with the blobs that it reads and writes, and what it keeps from pass to pass.

Caffe: include/caffe/layer.hpp, Net::ForwardFromTo, Net::BackwardFromTo (src/caffe/net.cpp)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from typing_extensions import override

from netspec.compat.pycaffe.tapes import (
    LayerKernels,
    Tape,
    by_autograd,
    gradient_of,
    not_shared,
    parameters,
    storages,
    undisturbed,
)
from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import Seen
from netspec.layers.utility.live_blobs import Blob
from netspec.layers.utility.pycaffe_shim import importable
from netspec.layers.utility.python import Python
from netspec.net.net import Net
from netspec.run.overwritten import Overwritten, reader_of_memory
from netspec.run.recorded import recorded


class LayerStep:
    """A layer, its blobs ``bottoms`` and ``tops``, and their numbers in the net, ``bottom_ids`` and ``top_ids``.

    ``losses`` are its tops with a loss weight. ``records``: autograd records its forward pass, for its backward pass.
    """

    def __init__(self, net: Net, i: int, blobs: list[Blob], bottom_ids: list[int], top_ids: list[int]) -> None:
        self.layer: Layer = net.layers[i]
        self.node = net.plan.nodes[i]
        self.bottom_ids, self.top_ids = bottom_ids, top_ids
        self.bottoms, self.tops = [blobs[b] for b in bottom_ids], [blobs[b] for b in top_ids]
        self.params = parameters(self.layer)
        weights = zip(self.tops, net.loss_weights[i], strict=True)
        self.losses = [(top, weight) for top, weight in weights if weight]
        self.constants = self.layer.filled_once()
        self.reads = self.layer.gradient_reads
        self.reached, self.wanted = net.backward_plan.layers[i], net.backward_plan.written[i]
        self._reader = reader_of_memory(self.layer, self.node, net.plan) if self.reads else None
        self._speed: Any = net.options.speed  # None, or netspec.fast.speed.Fast
        self._device = net.device
        self.records = self._is_asked() and not (self.reads or self.layer.shares)
        self.keeps_bottom = "kept" in self.reads and self._is_asked()
        self.has_kernels = self._can_bind()
        self._bottom: torch.Tensor | None = None  # what it read in its last pass, where it keeps that
        self._tape: Tape | None = None
        self._layer_kernels: LayerKernels | None = None

    def set_up(self) -> None:
        """Write the data that Caffe writes when it creates the layer."""
        for top, constant in zip(self.tops, self.constants, strict=False):
            if constant is not None:
                top.data_memory.put(constant.clone())
        for top, weight in self.losses:
            top.diff_memory.put(torch.full(top.shape, weight, device=self._device))

    def forget_run(self) -> None:
        """Forget the last run, so that a later backward pass reads the present blobs."""
        self._tape = None

    def forget_kernels(self) -> None:
        """Forget the kernels; the next run makes new ones."""
        self._layer_kernels = None

    @property
    def is_fresh(self) -> bool:
        """Whether the top of its prepared kernel has memory of its own, and not a bottom's."""
        return self._speed is not None and self._speed.is_fresh(self.layer)

    def _is_asked(self) -> bool:
        """Return whether a gradient of a bottom or a learnable blob is needed."""
        return self.reached and (any(self.wanted) or any(blob.requires_grad for blob in self.layer.blobs))

    def _can_bind(self) -> bool:
        """Return whether the layer has its own training kernels, so that autograd is not needed."""
        layer = self.layer
        return (
            self._speed is not None
            and self._device.type == "cpu"
            and not any(map(self._is_in_place, self.bottoms))
            and all(blob.dtype == torch.float32 and blob.is_contiguous() for blob in layer.blobs)
            and all(layer.blob(j) is blob for j, blob in enumerate(layer.blobs))
            and self._speed.learns(layer)
        )

    def _is_in_place(self, blob: Blob) -> bool:
        """Return whether the layer overwrites a bottom. It has then kept what its gradient needs."""
        return any(top is blob for top in self.tops)

    def _is_shaped_like(self, blob: Blob, read: torch.Tensor) -> bool:
        """Return whether a bottom has the shape that it had when the layer read it.

        A layer in place may have given it its own shape since: MVN makes four axes.
        """
        return read.numel() == blob.count if self._is_in_place(blob) else read.shape == blob.shape

    # Running

    def reshape(self) -> None:
        """Give the tops the shapes that follow from those of the bottoms."""
        if self.layer.is_input or not self.bottoms:
            return
        self.layer.fit([blob.shape for blob in self.bottoms])
        for top, shape in zip(self.tops, self.layer.top_shapes, strict=True):
            if top.shape != shape:
                top.reshape(*shape)

    def forward(self) -> tuple[torch.Tensor, ...]:
        """Run the layer, and return its losses from the memory of its tops."""
        if self.layer.shares:
            self.reshape()
        elif not self.layer.is_input:
            self._compute()
        return tuple([top.data_memory.tensor(top.shape) for top, _ in self.losses])

    def _compute(self) -> None:
        if self.records:
            tape = self._tape = self._record()
            values, tops = tape.leaves, tape.tops
        else:
            values = [blob.data_memory.tensor(blob.shape) for blob in self.bottoms]
            if self.keeps_bottom:
                self._bottom = values[0].clone()
            tops = self.layer.run(*values)
        constants = self.constants or [None] * len(tops)
        taken = storages(values or list(self.layer.blobs))
        for top, tensor, constant in zip(self.tops, tops, constants, strict=True):
            if constant is None:
                top.put_data(not_shared(tensor.detach(), taken))

    def _record(self) -> Tape:
        """Run the layer by its kernels, or with autograd."""
        if prepared := self._kernels():
            forward, backward = prepared.kernels
            values = [blob.data_memory.tensor(blob.shape) for blob in self.bottoms]
            holders = [blob.data_memory.holder(blob.count) for blob in self.bottoms]
            tops = forward(*values)
            return Tape(values, holders, (tops,) if isinstance(tops, torch.Tensor) else tops, backward)
        leaves, holders = [], []
        for blob, wanted in zip(self.bottoms, self.wanted, strict=True):
            memory = blob.data_memory
            value = memory.tensor(blob.shape)
            overwritten = memory.is_watched() and self._is_in_place(blob)
            leaves.append((value.clone() if overwritten else value.detach()).requires_grad_(wanted))
            holders.append(memory.holder(blob.count))
        with torch.enable_grad():
            tops = self.layer.run(*leaves)
        return Tape(leaves, holders, tops, partial(by_autograd, leaves, tops))

    def _kernels(self) -> LayerKernels | None:
        """Return the layer's kernels for its present shapes, or None if autograd must record it."""
        if not self.has_kernels or self._speed is None:
            return None
        layer, prepared = self.layer, self._layer_kernels
        shapes, blobs = [blob.shape for blob in self.bottoms], list(layer.blobs)
        learn = [blob.requires_grad for blob in blobs]
        if prepared is None or (prepared.shapes, prepared.learn) != (shapes, learn) or not prepared.seen.are(blobs):
            layer.fit(shapes)
            sums = tuple(gradient_of(blob) if blob.requires_grad else None for blob in blobs)
            kernels = self._speed.kernels(layer, self.wanted, sums) or recorded(layer.run, self.wanted, blobs)
            prepared = self._layer_kernels = LayerKernels(shapes, learn, Seen(blobs), kernels)
        return prepared

    def backward(self) -> None:
        """Write the diffs of the bottoms that need one from those of the tops, and add to those of learned blobs."""
        if not self.reached or "diff" in self.layer.shares:
            return
        tops = zip(self.tops, self.layer.top_shapes, strict=True)
        diffs = [top.diff_memory.tensor(_shape_of(top, made)) for top, made in tops]
        if self._reader:
            self._backward_from_memory(self._reader, diffs[0])
        elif self._is_asked():
            tape = self._present_tape()
            found = tape.backward(*diffs)
            if any(self.wanted):
                self._put_diffs((found,) if isinstance(found, torch.Tensor) else found, tape, storages(diffs))

    def _put_diffs(self, found: Sequence[torch.Tensor | None], tape: Tape, taken: set[int]) -> None:
        for blob, leaf, diff, asked in zip(self.bottoms, tape.leaves, found, self.wanted, strict=True):
            if asked:
                blob.diff_memory.put(not_shared(torch.zeros_like(leaf) if diff is None else diff, taken))

    def _backward_from_memory(self, reader: Overwritten, diff: torch.Tensor) -> None:
        """Compute the gradients from the present data, as Caffe does."""
        if not any(self.wanted):
            return
        first = self.tops[0]
        top = first.data_memory.tensor(diff.shape)
        values = [top if blob is first else blob.data_memory.tensor(blob.shape) for blob in self.bottoms]
        if self._bottom is not None and self._is_shaped_like(self.bottoms[0], self._bottom):
            values = [self._bottom]
        found = reader.gradients(values, top, diff)
        for blob, gradient, asked in zip(self.bottoms, found, self.wanted, strict=True):
            if asked:
                blob.diff_memory.put(gradient)

    def _present_tape(self) -> Tape:
        """Return the record of the last forward pass, with the present values of the bottoms.

        If the layer has not run with these shapes, it is run first, without an effect on the net.
        """
        tape, bottoms = self._tape, self.bottoms
        if tape is None or not all(map(self._is_shaped_like, bottoms, tape.leaves)):
            self.layer.fit([blob.shape for blob in bottoms])
            with undisturbed(self.layer):
                return self._record()
        for leaf, holder, blob in zip(tape.leaves, tape.holders, bottoms, strict=True):
            if self._is_in_place(blob) or blob.data_memory.holder(blob.count) is holder:
                continue
            value = blob.data_memory.tensor(blob.shape)
            if value.data_ptr() != leaf.data_ptr():  # else it has the values, and torch refuses to copy some shapes
                leaf.data.copy_(value)
        return tape


def _shape_of(top: Blob, made: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape that a layer gave to its top. A later layer in place may have given it another since."""
    return made if math.prod(made) == top.count else top.shape


class PythonStep(LayerStep):
    """A layer written in Python, whose code reads and writes the blobs itself."""

    layer: Python

    @override
    def set_up(self) -> None:
        if self.layer.code:
            self.layer.bottom[:], self.layer.top[:] = self.bottoms, self.tops
            self.layer.code.blobs[:] = self.params
        super().set_up()

    @override
    def _is_asked(self) -> bool:
        return False  # its code computes its gradient

    @override
    def reshape(self) -> None:
        if self.bottoms:
            with importable():
                self.layer.code.reshape(self.bottoms, self.tops)

    @override
    def _compute(self) -> None:
        with importable():
            self.layer.code.reshape(self.bottoms, self.tops)
            self.layer.code.forward(self.bottoms, self.tops)

    @override
    def backward(self) -> None:
        if self.reached:
            with importable():
                self.layer.code.backward(self.tops, list(self.wanted), self.bottoms)
