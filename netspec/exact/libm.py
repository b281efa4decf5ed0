"""Functions of the C library, which Caffe calls number by number.

The vector functions of torch and numpy round otherwise, here and there by a last bit. What reaches the C library's own
is taken where there is one; it is as fast as a loop in C. Values that are not on the CPU get torch's functions.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable

import numpy as np
import torch

from netspec.exact.blas import array, suits_blas

_LONGEST_STEP = 88  # cexpf computes exp(x) of a larger x as exp(88) exp(x - 88)


def exp(values: torch.Tensor) -> torch.Tensor:
    """Return exp(values) (caffe_exp), by way of the complex exponential: numpy calls the C library's."""
    if not suits_blas(values):
        return values.exp()
    if values.dtype == torch.float32 and values.amax() > _LONGEST_STEP:
        return _each("expf", values)
    real = array(values)
    found = np.exp(real.astype(np.result_type(real, np.complex64)))
    return torch.as_tensor(np.real(found)).contiguous()


def log(values: torch.Tensor) -> torch.Tensor:
    """Return the natural logarithms (caffe_log): torch's xlogy calls the C library's."""
    return torch.special.xlogy(values.new_ones(()), values) if suits_blas(values) else values.log()


def sqrt(values: torch.Tensor) -> torch.Tensor:
    """Return square roots as C rounds them (caffe_sqrt); torch's of floats may be off by the last bit."""
    return values.double().sqrt().to(values.dtype)


def power(values: torch.Tensor, exponent: float) -> torch.Tensor:
    """Return values ** exponent (caffe_powx).

    Torch's own loops square, take roots, or use a vector pow; where the operands have gaps between them, it calls the C
    library's powf for each.
    """
    if not suits_blas(values):
        return values.pow(exponent)
    gaps = values.new_ones(values.numel() + 1, 2)[:, 0]  # one more: a single value would have no gap
    gaps[:-1] = values.flatten()
    return torch.pow(gaps, values.new_full((1,), exponent).expand(len(gaps)))[:-1].reshape(values.shape)


def tanh(values: torch.Tensor) -> torch.Tensor:
    """Return hyperbolic tangents."""
    if not suits_blas(values):
        return values.tanh()
    return _each("tanhf", values) if values.dtype == torch.float32 else _map(math.tanh, values)


def sigmoid(values: torch.Tensor) -> torch.Tensor:
    """Return 1 / (1 + exp(-x)) as Caffe computes it: 0.5 tanh(0.5 x) + 0.5 in double."""
    return (0.5 * tanh(0.5 * values.double()) + 0.5).to(values.dtype)


def _each(name: str, values: torch.Tensor) -> torch.Tensor:
    """Return the values of a function of one float, called for each."""
    function = getattr(ctypes.CDLL(None), name)
    function.restype, function.argtypes = ctypes.c_float, [ctypes.c_float]
    return _map(function, values)


def _map(function: Callable[[float], float], values: torch.Tensor) -> torch.Tensor:
    flat = values.detach().flatten()
    found = np.fromiter(map(function, flat.tolist()), flat.numpy().dtype, len(flat))
    return torch.from_numpy(found).view(values.shape)
