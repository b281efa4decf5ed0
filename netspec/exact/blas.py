"""Caffe's arithmetic to the last bit: BLAS' sums in BLAS' order, and the C library's powf.

Float32 sums differ by their order in the last bits. Those decide between two nearly equal pixels in a max pooling, and
after that two trainings go different ways, so a run of Caffe can only be followed by computing as it did. Caffe hands
its products to OpenBLAS, and SciPy brings OpenBLAS along: on a CPU of the kind that Caffe ran on, equal calls give
equal bits.

Caffe: src/caffe/util/math_functions.cpp
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy.linalg import blas
from threadpoolctl import ThreadpoolController

_PREFIX = {torch.float32: "s", torch.float64: "d"}
_adding: ContextVar[bool] = ContextVar("adding_to_grad", default=False)


def suits_blas(tensor: torch.Tensor) -> bool:
    """Return whether the functions of this module take it: on the CPU, of single or double precision."""
    return tensor.device.type == "cpu" and tensor.dtype in _PREFIX


def _routine(name: str, tensor: torch.Tensor) -> Callable[..., Any]:
    return getattr(blas, _PREFIX[tensor.dtype] + name)


def gemm(
    a: torch.Tensor, b: torch.Tensor, c: torch.Tensor, *, a_t: bool = False, b_t: bool = False, add: bool = False
) -> None:
    """C = A B, or C += A B; ``a_t`` and ``b_t`` take the transposes of what is stored (caffe_cpu_gemm).

    All three are matrices, stored row by row without gaps. To BLAS, which goes by columns, they are their transposes.
    """
    call = _routine("gemm", c)
    views = [m.detach().numpy().T for m in (b, a, c)]
    call(1.0, views[0], views[1], beta=float(add), c=views[2], trans_a=b_t, trans_b=a_t, overwrite_c=True)


def add_sums(a: torch.Tensor, sums: torch.Tensor, axis: int, factor: float = 1.0) -> None:
    """Add the sums of matrix A along an axis, times a factor, as its product with a vector of ones (caffe_cpu_gemv)."""
    call = _routine("gemv", a)
    ones = torch.ones(a.shape[axis], dtype=a.dtype).numpy()
    call(factor, a.detach().numpy().T, ones, beta=1.0, y=sums.numpy(), trans=axis == 1, overwrite_y=True)


def sum_of_squares(values: torch.Tensor) -> torch.Tensor:
    """Return the sum of squares, () (caffe_cpu_dot of a blob with itself)."""
    flat = values.detach().flatten()
    if not suits_blas(values):
        return torch.dot(flat, flat)
    call = _routine("dot", values)
    with one_thread():
        return values.new_tensor(call(flat.numpy(), flat.numpy()))


def sum_in_order(values: torch.Tensor, axis: int = 0) -> torch.Tensor:
    """Return the sums along an axis, each value added to the sum of those before it (a plain loop of Caffe's)."""
    if not suits_blas(values) or not values.numel():
        return values.sum(axis)
    sums = np.add.accumulate(values.detach().numpy(), axis).take(-1, axis)
    return torch.as_tensor(sums, dtype=values.dtype)


def exponential(values: torch.Tensor) -> torch.Tensor:
    """Return exp(values) as the C library rounds it, which computes expf in double (caffe_exp)."""
    return values.double().exp().to(values.dtype)


def root(values: torch.Tensor) -> torch.Tensor:
    """Return square roots as C rounds them (caffe_sqrt); torch's of floats may be off by the last bit."""
    return values.double().sqrt().to(values.dtype)


def power(values: torch.Tensor, exponent: float) -> torch.Tensor:
    """Return values ** exponent as the C library's powf rounds it (caffe_powx).

    Torch's own loops square, take roots, or use a vector pow, all off by a last bit here and there; where the operands
    have gaps between them, it calls powf for each.
    """
    if not suits_blas(values):
        return values.pow(exponent)
    gaps = values.new_ones(values.numel() + 1, 2)[:, 0]  # one more: a single value would have no gap
    gaps[:-1] = values.flatten()
    return torch.pow(gaps, values.new_full((1,), exponent).expand(len(gaps)))[:-1].reshape(values.shape)


@contextmanager
def one_thread() -> Iterator[None]:
    """Within, BLAS uses one thread: others, like torch's waiting awake for more work, would hinder these."""
    with _pools().limit(limits=1):
        yield


@cache
def _pools() -> ThreadpoolController:
    return ThreadpoolController().select(internal_api="openblas")


@contextmanager
def adding_to_grad() -> Iterator[None]:
    """Within, what layers compute for a backward pass adds to the parameters' ``grad`` product by product.

    That is Caffe's order where layers share a parameter or several passes go into one update; autograd sums up each
    use by itself first. The gradients must be fetched by ``backward()``: ``torch.autograd.grad`` would miss them.
    """
    before = _adding.set(True)
    try:
        yield
    finally:
        _adding.reset(before)


def adds_to_grad(parameter: torch.Tensor) -> bool:
    """Return whether a product with this parameter is to add to its ``grad``."""
    return _adding.get() and parameter.is_leaf and parameter.is_contiguous()
