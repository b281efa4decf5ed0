"""Gradients of forks that are not the derivatives of what they compute. Nets were trained with them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


class _Instead(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        return value.view_as(value)

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[None, torch.Tensor]:
        return None, grads[0]


def with_gradient_of(other: Callable[[], torch.Tensor], value: torch.Tensor) -> torch.Tensor:
    """Return a value with the gradient of another of the same shape, which is not computed without gradients."""
    return _Instead.apply(value.detach(), other()) if torch.is_grad_enabled() else value
