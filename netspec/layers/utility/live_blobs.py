"""Blobs for pycaffe: ``data`` and ``diff`` are numpy views of memory that is kept from pass to pass.

The memory grows and never shrinks: a blob of a smaller shape uses its front. A view shows what the next pass writes.
Copying every blob into that memory would slow down each pass. So a tensor that a layer returns is kept as it is, also
in channels_last. It is only copied, or becomes the memory itself, when a view is needed.

Caffe: include/caffe/blob.hpp, src/caffe/syncedmem.cpp, python/caffe/_caffe.cpp
"""

from __future__ import annotations

import math
import operator
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from netspec.exact.layout import layout_of

Shape = tuple[int, ...]


def _no_view() -> np.ndarray | None:
    return None


class Memory:
    """Memory for ``capacity`` numbers (Caffe: SyncedMemory), zeros at first.

    ``view`` returns a view of it, ``tensor`` its content for layers to read, and ``put`` stores the result of a layer.
    On a GPU a view shows the content at the time of the call of ``view``, and writes to it take effect, as in Caffe.
    """

    def __init__(self) -> None:
        self.capacity = 0
        self.device = torch.device("cpu")
        self.dtype = torch.float32
        self._fresh: torch.Tensor | None = None  # what a layer stored after the last call of ``view``
        self._flat: torch.Tensor | None = None  # what views show, one axis, in main memory
        self._seen: Callable[[], np.ndarray | None] = _no_view  # the base of all views, while there is one
        self._uploaded: torch.Tensor | None = None  # ``_flat`` on the GPU

    def reserve(self, count: int) -> None:
        """Make room for ``count`` numbers. Memory that grows is replaced by zeros."""
        if count > self.capacity:
            self.capacity = count
            self._fresh = self._flat = self._uploaded = None
            self._seen = _no_view

    def view(self, shape: Shape) -> np.ndarray:
        """Return a view of the first numbers."""
        count = math.prod(shape)
        flat = self._settled(count)
        array = self._seen()
        if array is None:
            array = flat.numpy()
            self._seen = weakref.ref(array)
        self._uploaded = None
        return array[:count].reshape(shape)

    def tensor(self, shape: Shape) -> torch.Tensor:
        """Return the first numbers on the device. The caller must not write to the tensor."""
        count = math.prod(shape)
        if self._fresh is not None and self._fresh.numel() == count:
            if self._fresh.shape != shape:
                self._fresh = self._fresh.contiguous()
            return self._fresh.view(shape)
        flat = self._settled(count)[:count]
        if self.device.type == "cpu":
            return flat.view(shape)
        if self._uploaded is None or self._uploaded.numel() != count:
            self._uploaded = flat.to(self.device)
        return self._uploaded.view(shape)

    def put(self, tensor: torch.Tensor) -> None:
        """Store the result of a layer. The caller must not change the tensor afterwards."""
        self.reserve(tensor.numel())
        if tensor.dtype != self.dtype:
            self.cast(tensor.dtype)
        self._uploaded = None
        if self._flat is not None and self.is_watched():
            self._fresh = None
            write(self._flat, tensor)
        else:
            self._fresh = tensor.contiguous(memory_format=layout_of(tensor))
            if self._seen() is None:
                self._flat = None

    def leave_views(self) -> None:
        """Move the content to other memory if there are views, so that they no longer change."""
        if self.is_watched() and self._flat is not None:
            self._flat, self._seen = self._flat.clone(), _no_view

    def is_watched(self) -> bool:
        """Return whether there is a view, which must show the results of layers."""
        return self.device.type == "cpu" and self._seen() is not None

    def cast(self, dtype: torch.dtype) -> None:
        """Hold numbers of another precision, zeros at first."""
        if dtype != self.dtype:
            self.dtype, self._fresh, self._flat, self._uploaded, self._seen = dtype, None, None, None, _no_view

    def _settled(self, count: int) -> torch.Tensor:
        """Return the memory that views show, after writing the last result into it."""
        self.reserve(count)
        fresh, self._fresh = self._fresh, None
        if self._flat is None:
            if fresh is not None:
                fresh = fresh.contiguous()
                if self._is_all(fresh):
                    self._flat = fresh.detach().view(-1)
                    return self._flat
            self._flat = torch.zeros(self.capacity, dtype=self.dtype)
        if fresh is not None:
            write(self._flat, fresh)
        return self._flat

    def _is_all(self, tensor: torch.Tensor) -> bool:
        """Return whether a tensor can be the memory itself: it has the size, and its storage to itself."""
        whole = tensor.device.type == "cpu" and tensor.numel() == self.capacity and not tensor.is_inference()
        return whole and tensor.untyped_storage().nbytes() == tensor.numel() * tensor.element_size()


def write(flat: torch.Tensor, tensor: torch.Tensor) -> None:
    """Write a tensor to the front of memory. Tensors that autograd has saved change too, as in Caffe."""
    flat.data[: tensor.numel()].copy_(tensor.detach().reshape(-1))


class Blob:
    """An array and its gradient; ``data`` and ``diff`` are live views, read and written in place.

    Blobs may share ``data_memory`` and ``diff_memory`` (Caffe: ShareData, ShareDiff).
    """

    def __init__(self, shape: Shape = (), data: Memory | None = None, diff: Memory | None = None) -> None:
        """Make a blob: of zeros, or with the given memory."""
        self.data_memory = data or Memory()
        self.diff_memory = diff or Memory()
        self._shape: Shape = ()
        self.reshape(*shape)

    @property
    def data(self) -> np.ndarray:
        """The values."""
        return self.data_memory.view(self._shape)

    @property
    def diff(self) -> np.ndarray:
        """The gradient."""
        return self.diff_memory.view(self._shape)

    @property
    def shape(self) -> Shape:
        """The shape."""
        return self._shape

    @property
    def count(self) -> int:
        """The number of values."""
        return math.prod(self._shape)

    @property
    def num(self) -> int:
        """Axis 0, 1 where there is none; ``channels``, ``height`` and ``width`` likewise axes 1, 2 and 3."""
        return self._legacy_axis(0)

    channels = property(lambda self: self._legacy_axis(1))
    height = property(lambda self: self._legacy_axis(2))
    width = property(lambda self: self._legacy_axis(3))

    def reshape(self, *shape: int) -> None:
        """Change the shape. The values stay in place; if the memory has to grow, they become 0."""
        axes = tuple(operator.index(size) for size in shape)
        if min(axes, default=0) < 0:
            raise ValueError(f"Check failed: shape[i] >= 0: found shape {axes}, expected no negative size")
        if len(axes) > MOST_AXES:
            raise ValueError(f"Check failed: shape.size() <= kMaxBlobAxes ({len(axes)} vs. {MOST_AXES})")
        self._shape = axes
        self.data_memory.reserve(self.count)
        self.diff_memory.reserve(self.count)

    def put_data(self, tensor: torch.Tensor) -> None:
        """Store the values that a layer has computed, and their shape."""
        if tensor.shape != self._shape:
            self.reshape(*tensor.shape)
        self.data_memory.put(tensor)

    def _legacy_axis(self, axis: int) -> int:
        if len(self._shape) > 4:
            message = "Check failed: num_axes() <= 4: Cannot use legacy accessors on Blobs with > 4 axes."
            raise ValueError(f"{message} This one has shape {self._shape}")
        return self._shape[axis] if axis < len(self._shape) else 1


MOST_AXES = 32  # caffe: kMaxBlobAxes


class BlobVec(Sequence[Blob]):
    """A layer's learnable blobs. A blob cannot be replaced, only written to: ``blobs[0].data[...] = array``."""

    def __init__(self, blobs: Iterable[Blob] = ()) -> None:
        self._blobs = list(blobs)

    @override
    def __getitem__(self, index: Any) -> Any:
        return self._blobs[index]

    @override
    def __len__(self) -> int:
        return len(self._blobs)

    def __setitem__(self, index: Any, value: Any) -> None:
        raise TypeError("Invalid assignment: a layer's blob cannot be replaced; write blobs[i].data[...] = array")

    def add_blob(self, *shape: int) -> None:
        """Append a blob of zeros."""
        self._blobs.append(Blob(shape))
