"""What this machine computes with other bits than the one on which the golden files were computed."""

from __future__ import annotations

import hashlib
from functools import cache

import numpy as np
import torch

from netspec.exact import blas, libm

_COUNT = 300  # values of each function
_EXPONENTS = (0.75, -0.75, -1.0, 3.0)  # of LRN and Power
_GLIBCS = {  # digests with glibc 2.36 on x86-64
    "exp": "86a89be0508b1ac3",
    "log": "8f02ed9a6ec4f411",
    "pow": "bde7644dffa81b83",
    "tanh": "1ab49b116244cba9",
}


def other_bits() -> str:
    """Return a sentence about what is computed with other bits than in the golden files; "" if nothing is."""
    return "; ".join(note for note in (_sums(), _functions()) if note)


def _sums() -> str:
    found = blas.kernels()
    if blas.CAFFES in found:
        return ""
    if not found:
        return (
            f"Caffe's sums are computed by another BLAS ({blas.name()}), not OpenBLAS: their last bits differ from "
            "those of a Caffe with OpenBLAS"
        )
    return (
        f"Caffe's sums are computed by the kernels for {', '.join(sorted(found))}, not {blas.CAFFES} (AVX-512): "
        "they have the bits of a Caffe on such a CPU"
    )


def _functions() -> str:
    other = [name for name, digest in digests().items() if digest != _GLIBCS[name]]
    if not other:
        return ""
    return f"this C library rounds {', '.join(other)} otherwise than glibc 2.36, with which Caffe was compared"


@cache
def digests() -> dict[str, str]:
    """Return a digest for each function of :mod:`netspec.exact.libm` that calls the C library: of 300 values each."""
    numbers = np.random.Philox(59).random_raw(_COUNT) / 2.0**64  # from 0 to 1, equal on every system
    unit = torch.from_numpy(numbers)
    around, above = 40 * unit - 20, 100 * unit + 1e-3
    return {
        "exp": _digest(libm.exp(around.float()), libm.exp(around)),
        "log": _digest(libm.log(above.float()), libm.log(above)),
        "pow": _digest(*(libm.power(above.float(), exponent) for exponent in _EXPONENTS)),
        "tanh": _digest(libm.tanh(around / 4)),
    }


def _digest(*results: torch.Tensor) -> str:
    found = hashlib.sha256()
    for result in results:
        found.update(result.numpy().tobytes())
    return found.hexdigest()[:16]
