"""Decides whether sums are computed in Caffe's order."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

import torch

from netspec.exact import ALL, SMALL
from netspec.exact.blas import suits_blas


def applies(exact: str, values: torch.Tensor, small: bool = False) -> bool:
    """Return whether to use Caffe's order: if ``exact`` is "all", or if it is "small" and the work is ``small``.

    Never while operations are recorded, because Caffe's order is computed with numpy, which cannot be recorded.
    """
    if exact != ALL and not (small and exact == SMALL):
        return False
    return suits_blas(values) and not is_recorded()


def is_recorded() -> bool:
    """Return whether operations are recorded (traced or compiled), not only run."""
    return torch.compiler.is_compiling() or torch.jit.is_tracing()
