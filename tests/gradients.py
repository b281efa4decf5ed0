"""Compares gradients with finite differences."""

from collections.abc import Callable, Sequence

import torch


def check_gradients(
    function: Callable[..., torch.Tensor | Sequence[torch.Tensor]], inputs: Sequence[torch.Tensor], rtol: float = 1e-7
) -> None:
    """Compare the Jacobians of a function in double precision along random directions.

    The tolerances detect an error of a thousandth in one element of 400. The default ones would not, along directions.
    """
    assert torch.autograd.gradcheck(function, inputs, fast_mode=True, rtol=rtol, atol=1e-9)
