"""What ``import caffe`` gives to the code of a Python layer where no pycaffe is installed: Layer, TRAIN, TEST.

Caffe: python/caffe/_caffe.cpp
"""

from __future__ import annotations

import importlib.util
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, NoReturn

import numpy as np

TRAIN, TEST = 0, 1


class Blob:
    """An array and its gradient, as pycaffe shows them: ``data`` and ``diff`` are live views."""

    def __init__(self, shape: tuple[int, ...] = ()) -> None:
        """Make a blob of zeros."""
        self._data = np.zeros(shape, np.float32)
        self._diff = np.zeros(shape, np.float32)

    @property
    def data(self) -> np.ndarray:
        """The values."""
        return self._data

    @property
    def diff(self) -> np.ndarray:
        """The gradient."""
        return self._diff

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape."""
        return self._data.shape

    @property
    def count(self) -> int:
        """How many values there are."""
        return self._data.size

    @property
    def num(self) -> int:
        """Axis 0, 1 where there is none."""
        return self._legacy_axis(0)

    @property
    def channels(self) -> int:
        """Axis 1, 1 where there is none."""
        return self._legacy_axis(1)

    @property
    def height(self) -> int:
        """Axis 2, 1 where there is none."""
        return self._legacy_axis(2)

    @property
    def width(self) -> int:
        """Axis 3, 1 where there is none."""
        return self._legacy_axis(3)

    def reshape(self, *shape: int) -> None:
        """Take another shape; the values stay where their count does, else they are 0."""
        if math.prod(shape) == self.count:
            self._data, self._diff = self._data.reshape(shape), self._diff.reshape(shape)
        else:
            self._data, self._diff = np.zeros(shape, self._data.dtype), np.zeros(shape, self._data.dtype)

    def bind(self, data: np.ndarray) -> None:
        """Show an array, with a gradient of 0. For netspec, not for the code of layers."""
        self._data, self._diff = data, np.zeros_like(data)

    def cast(self, dtype: np.dtype) -> None:
        """Hold numbers of another precision. For netspec, not for the code of layers."""
        self._data, self._diff = self._data.astype(dtype, copy=False), self._diff.astype(dtype, copy=False)

    def _legacy_axis(self, axis: int) -> int:
        return self.shape[axis] if axis < len(self.shape) else 1


class BlobVec(list[Blob]):
    """A layer's learnable blobs."""

    def add_blob(self, *shape: int) -> None:
        """Append a blob of zeros."""
        self.append(Blob(shape))


class Layer:
    """Base of the layers that people write: they add forward(bottom, top), backward(top, propagate_down, bottom)."""

    param_str: str
    phase: int

    def __init__(self, param: Any) -> None:
        """Make a layer without blobs; ``param`` is its LayerParameter."""
        self.blobs = BlobVec()

    def setup(self, bottom: list[Blob], top: list[Blob]) -> None:
        """Do what is to be done once."""

    def reshape(self, bottom: list[Blob], top: list[Blob]) -> None:
        """Give the tops their shapes."""


def __getattr__(name: str) -> NoReturn:
    raise AttributeError(f"netspec's stand-in for pycaffe has no {name}; it offers Layer, TRAIN and TEST")


@contextmanager
def importable() -> Iterator[None]:
    """Let code import this module as ``caffe``, unless there is a real one, and modules of the current directory."""
    directory = os.getcwd()
    sys.path.insert(0, directory)
    stand_in = "caffe" not in sys.modules and not _is_installed(directory)
    if stand_in:
        sys.modules["caffe"] = sys.modules[__name__]
    try:
        yield
    finally:
        sys.path.remove(directory)
        if stand_in:
            sys.modules.pop("caffe", None)


@cache
def _is_installed(directory: str) -> bool:
    """Say whether Python, run in a directory, finds a caffe; a mere folder of that name (Caffe's sources) is none."""
    spec = importlib.util.find_spec("caffe")
    return spec is not None and spec.origin is not None
