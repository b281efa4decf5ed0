"""Kernels of oneDNN that torch's compiler uses: weights laid out in advance, an activation in the same pass.

They take and return maps whose channels lie side by side (channels_last). Where torch does not have them, the usual
functions do the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch.nn import functional as F

from netspec.layers.base import Kernel, Preparation, finished
from netspec.layers.learned import values_of

_CONVOLVE, _MULTIPLY = "_convolution_pointwise", "_linear_pointwise"


def _ops() -> Any:
    return torch.ops.mkldnn


def suits(weight: torch.Tensor) -> bool:
    """Return whether there are such kernels for weights like these."""
    here = weight.device.type == "cpu" and weight.dtype == torch.float32 and weight.numel() > 0
    return here and torch.backends.mkldnn.is_available() and hasattr(_ops(), _CONVOLVE) and hasattr(_ops(), _MULTIPLY)


def has_bfloat16() -> bool | None:
    """Return whether the CPU multiplies bfloat16 numbers, None where torch cannot tell."""
    found = [getattr(torch.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported")]
    return any(test() for test in found if test) if any(found) else None


def convolution(
    weight: torch.Tensor,
    bias: torch.Tensor | None,
    stride: Sequence[int],
    pad: Sequence[int],
    dilation: Sequence[int],
    group: int,
    how: Preparation,
) -> Kernel:
    """Return a convolution by fixed weights (num_output, C / group, kernel_h, kernel_w)."""
    geometry = [list(pad), list(stride), list(dilation), group]
    side_by_side = torch.channels_last
    weight = how.memo(f"weight {geometry}", lambda: _laid_out(values_of(weight), geometry))
    bias = None if bias is None else how.memo("bias", values_of(bias).clone)
    call, relu = _ops()._convolution_pointwise.default, how.finish is F.relu_
    arguments = (*geometry, "relu" if relu else "none", [], "")

    def kernel(maps: torch.Tensor) -> torch.Tensor:
        return call(maps.contiguous(memory_format=side_by_side), weight, bias, *arguments)

    return finished(kernel, None if relu else how.finish)


def _laid_out(weight: torch.Tensor, geometry: Sequence[Any]) -> torch.Tensor:
    return _ops()._reorder_convolution_weight(weight.contiguous(), *geometry, [])


def product(weight: torch.Tensor, bias: torch.Tensor | None, how: Preparation) -> Kernel:
    """Return the product of vectors (M, K) with fixed weights (num_output, K)."""
    weight = how.memo("weight", lambda: _ops()._reorder_linear_weight(values_of(weight).contiguous()))
    bias = None if bias is None else how.memo("bias", values_of(bias).clone)
    call, relu = _ops()._linear_pointwise.default, how.finish is F.relu_
    arguments = ("relu" if relu else "none", [], "")
    return finished(lambda vectors: call(vectors, weight, bias, *arguments), None if relu else how.finish)
