"""Sums over the classes of many small images at once, in the order in which BLAS sums up each image.

Caffe calls BLAS once for each image. With few classes, the calls take longer than the sums. In which order BLAS adds
depends on the CPU and on the shape, so the order is found by experiment: one of the known orders is used if it gave the
same bits as BLAS for thousands of random images.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from netspec.exact.blas import one_thread, routine

_FEWEST = 4  # images: for fewer, calls of BLAS are as fast
_LARGEST = 64  # numbers of an image: for more, calls of BLAS are as fast
_SEARCHED, _VERIFIED = 64, 2048  # random images to search for an order, and to verify it


class _Order(NamedTuple):
    """Blocks of ``size`` classes are summed, then the sums of the blocks.

    The classes that do not fill a block are one more block if ``short_block``; otherwise they are added one by one.
    """

    size: int
    short_block: bool


_ORDERS = [_Order(1, False), *(_Order(size, short) for size in (2, 4, 8, 16) for short in (False, True))]


def class_sums(values: np.ndarray) -> np.ndarray:
    """Return the sums (N, inner) over axis 1 of values (N, classes, inner), with the bits of gemv (caffe_cpu_gemv).

    BLAS must have one thread. The sum of values that are all -0.0 may be 0.0 or -0.0.
    """
    count, classes, inner = values.shape
    if count >= _FEWEST and classes * inner <= _LARGEST:
        order = _order(classes, inner, values.dtype.char)
        if order is not None:
            return _in_order(values, order)
    return _by_calls(values)


def _by_calls(values: np.ndarray) -> np.ndarray:
    sums = np.zeros((len(values), values.shape[2]), values.dtype)
    add_up, ones = routine("gemv", values), np.ones(values.shape[1], values.dtype)
    for image, total in zip(values, sums, strict=True):
        add_up(1.0, image.T, ones, 1.0, total, 0, 1, 0, 1, 0, 1)
    return sums


def _in_order(values: np.ndarray, order: _Order) -> np.ndarray:
    if order.size > 1:
        count, classes, inner = values.shape
        whole = classes - classes % order.size
        blocks = _one_by_one(values[:, :whole].reshape(count, -1, order.size, inner), 2)
        rest = values[:, whole:]
        if order.short_block and whole < classes:
            rest = _one_by_one(rest, 1)[:, None]
        values = np.concatenate([blocks, rest], 1)
    return _one_by_one(values, 1)


def _one_by_one(values: np.ndarray, axis: int) -> np.ndarray:
    return np.add.accumulate(values, axis).take(-1, axis)


@cache
@one_thread()
def _order(classes: int, inner: int, kind: str) -> _Order | None:
    """Return the order in which BLAS sums this number of classes; None if it is not one of the known orders.

    ``kind``: the type of the values, as numpy's dtype.char.
    """
    random = np.random.default_rng(0)
    shape = (_VERIFIED, classes, inner)
    size = np.exp2(random.integers(-12, 12, shape))  # sums of numbers of one size often agree in any order
    values = (random.uniform(-1, 1, shape) * size).astype(kind)
    found = [order for order in _ORDERS if _agree(values[:_SEARCHED], order)]
    return next((order for order in found if _agree(values, order)), None)


def _agree(values: np.ndarray, order: _Order) -> bool:
    return order.size <= values.shape[1] and np.array_equal(_in_order(values, order), _by_calls(values))
