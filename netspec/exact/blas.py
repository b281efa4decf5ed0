"""Caffe's calls of BLAS, with the OpenBLAS of SciPy: on the same kind of CPU, equal calls give equal bits.

Caffe: src/caffe/util/math_functions.cpp
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
import torch

Values = torch.Tensor | np.ndarray  # a loop over images is faster on arrays, which it makes once

_IN_DOUBLE = 32  # OpenBLAS' dot sums up fewer products than this in double, one by one


def suits_blas(tensor: torch.Tensor) -> bool:
    """Return whether the functions of this module accept it: values on the CPU, of single or double precision."""
    return tensor.device.type == "cpu" and tensor.dtype in (torch.float32, torch.float64) and tensor.numel() > 0


def array(values: Values) -> np.ndarray:
    """Return values on the CPU as an array that shares their memory."""
    return values if isinstance(values, np.ndarray) else values.detach().numpy()


def _routine(name: str, values: np.ndarray) -> Callable[..., Any]:
    from scipy.linalg import blas  # half a second, for which nets without exact sums need not wait

    return getattr(blas, values.dtype.char.replace("f", "s") + name)


def gemm_routine(values: np.ndarray) -> Callable[..., Any]:
    """Return BLAS' product of matrices for numbers of this type: (1, b.T, a.T, 0, c.T, 0, 0, 1) makes c = a b."""
    return _routine("gemm", values)


def gemm(a: Values, b: Values, c: Values, *, a_t: bool = False, b_t: bool = False, add: bool = False) -> None:
    """C = A B, or C += A B; ``a_t`` and ``b_t`` take the transposes of what is stored (caffe_cpu_gemm).

    All three are matrices, stored row by row without gaps. To BLAS, which goes by columns, they are their transposes.
    """
    a, b, c = array(a), array(b), array(c)
    _routine("gemm", c)(1.0, b.T, a.T, beta=float(add), c=c.T, trans_a=b_t, trans_b=a_t, overwrite_c=True)


def add_sums(a: Values, sums: Values, axis: int, factor: float = 1.0) -> None:
    """Add the sums of matrix A along an axis, times a factor, as its product with a vector of ones (caffe_cpu_gemv)."""
    a, sums = array(a), array(sums)
    ones = np.ones(a.shape[axis], a.dtype)
    _routine("gemv", a)(factor, a.T, ones, beta=1.0, y=sums, trans=axis == 1, overwrite_y=True)


def dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the sum of the products of two tensors of equal counts, () (caffe_cpu_dot)."""
    first, second = array(a).reshape(-1), array(b).reshape(-1)
    return a.new_tensor(_routine("dot", first)(first, second))


def dots(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the sums (N, M) along axis 1 of the products of A and B, both (N, K, M) (caffe_cpu_strided_dot)."""
    count, length, stride = a.shape
    if stride == 1 and length < _IN_DOUBLE:
        return sum_in_order((a * b).double(), 1).to(a.dtype)
    flat = [array(values.contiguous()).reshape(-1) for values in (a, b)]
    call = _routine("dot", flat[0])
    starts = (n * length * stride + m for n in range(count) for m in range(stride))
    found = [call(*flat, n=length, offx=k, incx=stride, offy=k, incy=stride) for k in starts]
    return a.new_tensor(found).view(count, stride)


def sum_of_magnitudes(values: torch.Tensor) -> torch.Tensor:
    """Return the sum of the absolute values, () (caffe_cpu_asum)."""
    flat = array(values).reshape(-1)
    return values.new_tensor(_routine("asum", flat)(flat))


def sum_of_squares(values: torch.Tensor) -> torch.Tensor:
    """Return the sum of squares, () (caffe_cpu_dot of a blob with itself)."""
    flat = values.detach().flatten()
    if not suits_blas(values):
        return torch.dot(flat, flat)
    with one_thread():
        return dot(flat, flat)


def sum_in_order(values: torch.Tensor, axis: int = 0) -> torch.Tensor:
    """Return the sums along an axis, each value added to the sum of those before it (a plain loop of Caffe's)."""
    sums = np.add.accumulate(array(values), axis).take(-1, axis)
    return torch.as_tensor(sums, dtype=values.dtype)


@contextmanager
def one_thread() -> Iterator[None]:
    """Within the block BLAS uses one thread: more threads would busy-wait, like torch's, and slow each other down."""
    before = [(pool, count) for pool in _pools() if (count := pool.get_num_threads()) != 1]
    for pool, _ in before:
        pool.set_num_threads(1)
    try:
        yield
    finally:
        for pool, count in before:
            pool.set_num_threads(count)


@cache
def _pools() -> list[Any]:
    """Return the OpenBLAS that SciPy brings, or every one there is where SciPy's has no place of its own."""
    import scipy.linalg  # noqa: F401  so that its OpenBLAS is there
    from threadpoolctl import ThreadpoolController

    pools = ThreadpoolController().select(internal_api="openblas").lib_controllers
    return [pool for pool in pools if "scipy.libs" in pool.filepath] or pools
