"""Whether a value is computed in Caffe's order."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

import torch

from netspec.exact import ALL, SMALL
from netspec.exact.blas import suits_blas


def applies(exact: str, values: torch.Tensor, small: bool = False) -> bool:
    """Return whether ``exact`` asks for Caffe's order: it is "all", or "small" and what is computed is ``small`` too.

    What computes so calls into numpy, which tools that record a net's operations cannot follow: there it never applies.
    """
    if exact != ALL and not (small and exact == SMALL):
        return False
    return suits_blas(values) and not is_recorded()


def is_recorded() -> bool:
    """Return whether operations are recorded, not only run."""
    return torch.compiler.is_compiling() or torch.jit.is_tracing()
