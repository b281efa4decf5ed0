"""Adds up the gradients of parameters in Caffe's order.

Autograd computes the gradient of each use of a parameter separately, and then adds those of all uses and passes.
Caffe adds each product to the parameter's ``diff`` at once: image by image, layer by layer, pass by pass. A net built
with ``accumulate_in_place`` works like Caffe: its layers add to ``grad`` themselves and return no gradient to
autograd. The solver builds its nets in this way. Hooks on parameters, ``torch.autograd.grad`` and wrappers like DDP
see the gradients of nets built without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch


class _AddedAtOnce(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, parameter: torch.Tensor) -> torch.Tensor:
        ctx.parameter = parameter
        return parameter.view_as(parameter)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> None:
        parameter = ctx.parameter
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        parameter.grad += gradients[0]


def added_at_once(parameter: torch.Tensor) -> torch.Tensor:
    """Return a parameter for one use; the gradient of this use is added to ``grad`` as soon as it is known."""
    is_learned = isinstance(parameter, torch.nn.Parameter) and parameter.requires_grad
    return _AddedAtOnce.apply(parameter) if is_learned and parameter.is_contiguous() else parameter


class ParameterSums(torch.autograd.Function):
    """Base of functions that add up the gradients of their parameters themselves.

    Their arguments begin with one bottom, then the parameters, each a tensor or None.
    """

    @staticmethod
    def keep(ctx: Any, bottom: torch.Tensor, parameters: Sequence[torch.Tensor | None], in_place: bool) -> None:
        """Save the bottom and the parameters for backward, and whether it must add ``in_place``."""
        ctx.save_for_backward(bottom, *parameters)
        ctx.adds = [in_place and isinstance(p, torch.nn.Parameter) and p.is_contiguous() for p in parameters]

    @staticmethod
    def sums(ctx: Any) -> list[torch.Tensor | None]:
        """Return where to add the gradient of each parameter; None if it is not needed."""
        found: list[torch.Tensor | None] = []
        needed = ctx.needs_input_grad[1 : 1 + len(ctx.adds)]
        for parameter, asked, adds in zip(ctx.saved_tensors[1:], needed, ctx.adds, strict=True):
            if not asked:
                found.append(None)
            elif not adds:
                found.append(torch.zeros_like(parameter, memory_format=torch.contiguous_format))
            else:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
                found.append(parameter.grad)
        return found

    @staticmethod
    def for_autograd(ctx: Any, sums: Sequence[torch.Tensor | None]) -> list[torch.Tensor | None]:
        """Return the gradients for autograd to add; None for those that were already added."""
        return [None if added else total for added, total in zip(ctx.adds, sums, strict=True)]
