"""Functions of the C library, which Caffe calls for each number.

The vector functions of torch and numpy sometimes differ from it in the last bit. So functions of torch or numpy are
used that call the C library's function for each number. They are as fast as a loop in C. For values that are not on the
CPU, torch's usual functions are used.

The golden files were computed with glibc 2.36. glibc 2.41 and 2.43 have the same expf, logf, powf and double tanh, but
another tanhf: since 2.41 it is rounded correctly, which changes the last bit of many values. So tanhf is computed here
as in 2.36, on every system.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from functools import cache

import numpy as np
import torch

from netspec.exact.blas import array, suits_blas

_LONGEST_STEP = 88  # cexpf computes exp(x) of a larger x as exp(88) exp(x - 88)


def exp(values: torch.Tensor) -> torch.Tensor:
    """Return exp(values) (caffe_exp), by numpy's complex exponential, which calls the C library's."""
    if not suits_blas(values):
        return values.exp()
    if values.dtype == torch.float32 and values.amax() > _LONGEST_STEP:
        function = _expf()
        return _map(function, values) if function else values.double().exp().float()
    real = array(values)
    found = np.exp(real.astype(np.result_type(real, np.complex64)))
    return torch.as_tensor(np.real(found)).contiguous()


def log(values: torch.Tensor) -> torch.Tensor:
    """Return the natural logarithms (caffe_log): torch's xlogy calls the C library's."""
    return torch.special.xlogy(values.new_ones(()), values) if suits_blas(values) else values.log()


def sqrt(values: torch.Tensor) -> torch.Tensor:
    """Return correctly rounded square roots (caffe_sqrt); torch's of floats may differ in the last bit."""
    return values.double().sqrt().to(values.dtype)


def power(values: torch.Tensor, exponent: float) -> torch.Tensor:
    """Return values ** exponent (caffe_powx).

    Torch squares, takes roots or uses a vector function, except for operands that are not contiguous in memory: for
    these it calls the C library's powf for each number.
    """
    if not suits_blas(values):
        return values.pow(exponent)
    gaps = values.new_ones(values.numel() + 1, 2)[:, 0]  # one more: a single value would have no gap
    gaps[:-1] = values.flatten()
    return torch.pow(gaps, values.new_full((1,), exponent).expand(len(gaps)))[:-1].reshape(values.shape)


def tanh(values: torch.Tensor) -> torch.Tensor:
    """Return hyperbolic tangents, with the bits of glibc up to 2.40 for floats."""
    if not suits_blas(values):
        return values.tanh()
    if values.dtype == torch.float32:
        return torch.from_numpy(_tanhf(array(values).reshape(-1))).view(values.shape)
    return _map(math.tanh, values)


def sigmoid(values: torch.Tensor) -> torch.Tensor:
    """Return 1 / (1 + exp(-x)) as Caffe computes it: 0.5 tanh(0.5 x) + 0.5 in double."""
    return (0.5 * tanh(0.5 * values.double()) + 0.5).to(values.dtype)


_FLOAT = np.float32
_ONE_FROM = _FLOAT(10)  # from this value on, the hyperbolic tangent is rounded to 1
_LN2_HIGH, _LN2_LOW = _FLOAT(6.9313812256e-01), _FLOAT(9.0580006145e-06)  # their sum is ln 2
_INVERSE_LN2 = _FLOAT(1.4426950216)
# The coefficients of the polynomial in r^2 / 2, from the highest power on; the last is 1.
_EXPM1 = [_FLOAT(c) for c in (-2.0109921195e-07, 4.0082177293e-06, -7.9365076090e-05, 1.5873016091e-03)]
_EXPM1 += [_FLOAT(-3.3333335072e-02), _FLOAT(1)]


def _tanhf(x: np.ndarray) -> np.ndarray:
    """Return the hyperbolic tangents of floats (n,) with fdlibm's bits.

    tanh |x| = 1 - 2 / (e + 2) with e = exp(2 |x|) - 1; below 1 it is -e / (e + 2) with e = exp(-2 |x|) - 1.
    NumPy rounds each operation to float and fuses none, so that the bits are the same on every CPU.

    fdlibm (Sun Microsystems 1993), s_tanh.c, for floats: s_tanhf.c of glibc up to 2.40
    """
    size = np.fmin(np.abs(x), _ONE_FROM)  # NaN becomes a number, too
    below = size < 1
    with np.errstate(under="ignore"):
        e = _expm1f(np.where(below, -2 * size, 2 * size))
        found = np.where(below, -e / (e + 2), 1 - 2 / (e + 2))
    return np.where(np.isnan(x), x, np.copysign(found, x))


def _expm1f(x: np.ndarray) -> np.ndarray:
    """Return exp(x) - 1 of floats (n,) from -2 to 20, with x = k ln 2 + r: a polynomial in r gives exp(r) - 1.

    fdlibm, s_expm1.c, for floats: s_expm1f.c of glibc up to 2.40
    """
    k = np.trunc(x * _INVERSE_LN2 + np.copysign(_FLOAT(0.5), x))
    high, low = x - k * _LN2_HIGH, k * _LN2_LOW
    r = high - low
    lost = (high - r) - low  # by the rounding of r
    half = r * _FLOAT(0.5)
    squared = r * half
    ratio = np.zeros_like(r)
    for coefficient in _EXPM1:
        ratio = ratio * squared + coefficient
    t = 3 - ratio * half
    e = squared * ((ratio - t) / (6 - r * t))
    e = (r * (e - lost) - lost) - squared  # exp(r) - 1 = r - e
    scale = np.ldexp(_FLOAT(1), k.astype(np.int32))
    inverse = 1 / scale
    # The order of these additions determines the rounding.
    return np.select(
        [k < -1, k < 1, k < 23],
        [
            scale * (1 - (e - r)) - 1,
            scale * (r - e) + (scale - 1),
            scale * ((1 - inverse) - (e - r)),
        ],
        scale * ((r - (e + inverse)) + 1),
    )


@cache
def _expf() -> Callable[[float], float] | None:
    """Return the C library's function, or None where a program cannot look up its own functions (Windows).

    There, exp in double, rounded to float, is used. Of the 98,304 floats from 88 to 88.75, it rounds 59 otherwise than
    glibc.
    """
    try:
        function = ctypes.CDLL(None).expf
    except (TypeError, OSError, AttributeError):
        return None
    function.restype, function.argtypes = ctypes.c_float, [ctypes.c_float]
    return function


def _map(function: Callable[[float], float], values: torch.Tensor) -> torch.Tensor:
    flat = values.detach().flatten()
    found = np.fromiter(map(function, flat.tolist()), flat.numpy().dtype, len(flat))
    return torch.from_numpy(found).view(values.shape)
