"""Adds up the gradients of parameters in Caffe's order.

Autograd computes the gradient of each use of a parameter separately, and then adds those of all uses and passes.
Caffe adds each product to the parameter's ``diff`` at once: image by image, layer by layer, pass by pass. A net built
with ``accumulate_in_place`` works like Caffe: its layers add to ``grad`` themselves and return no gradient to
autograd. The solver builds its nets in this way. Hooks on parameters, ``torch.autograd.grad`` and wrappers like DDP
see the gradients of nets built without it.
"""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any, Protocol

import torch
from torch.autograd.function import once_differentiable

from netspec.exact.blas import one_thread

Diff = torch.Tensor | None
Sums = Sequence[Diff]  # the tensors to which the gradients of parameters are added; None: not needed


class Operation(Protocol):
    """A function of a bottom and of parameters that adds up the gradients of the parameters itself.

    - ``forward(bottom, *parameters)`` returns the top. A parameter may be None.
    - ``backward(diff, wanted, sums, bottom, *parameters)`` takes the gradient of the top, and returns that of the
      bottom if it is ``wanted``. ``sums`` are the tensors to which it adds the gradients of the parameters; None for
      those that are not needed.
    """

    @property
    def forward(self) -> Callable[..., torch.Tensor]: ...

    @property
    def backward(self) -> Callable[..., Diff]: ...


class Applied(torch.autograd.Function):
    """The top of an operation. With ``in_place``, the gradients of parameters are added to ``grad`` at once.

    ``by_blas``: whether the operation calls the routines of netspec/exact/blas.py.
    """

    @staticmethod
    def forward(
        ctx: Any, operation: Operation, by_blas: bool, in_place: bool, bottom: Diff, *parameters: Diff
    ) -> torch.Tensor:
        ctx.operation, ctx.by_blas = operation, by_blas
        ctx.save_for_backward(bottom, *parameters)
        ctx.adds = [in_place and isinstance(p, torch.nn.Parameter) and p.is_contiguous() for p in parameters]
        with one_thread() if by_blas else nullcontext():
            return operation.forward(bottom, *parameters)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, diff: torch.Tensor) -> tuple[Diff, ...]:
        bottom, *parameters = ctx.saved_tensors
        wanted, *needed = ctx.needs_input_grad[3:]
        sums = [
            _sum(parameter, adds) if asked else None
            for parameter, asked, adds in zip(parameters, needed, ctx.adds, strict=True)
        ]
        with one_thread() if ctx.by_blas else nullcontext():
            found = ctx.operation.backward(diff, wanted, sums, bottom, *parameters)
        returned = (None if added else total for added, total in zip(ctx.adds, sums, strict=True))
        return None, None, None, found, *returned


def _sum(parameter: torch.Tensor, adds: bool) -> torch.Tensor:
    """Return the tensor to which the gradient of a parameter is added: its ``grad``, or zeros."""
    if not adds:
        return torch.zeros_like(parameter, memory_format=torch.contiguous_format)
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter)
    return parameter.grad


def added_at_once(parameter: torch.Tensor) -> torch.Tensor:
    """Return a parameter for one use; the gradient of this use is added to ``grad`` as soon as it is known."""
    is_learned = isinstance(parameter, torch.nn.Parameter) and parameter.requires_grad and parameter.is_contiguous()
    return Applied.apply(_Use(), False, True, None, parameter) if is_learned else parameter


class _Use:
    def forward(self, _: None, parameter: torch.Tensor) -> torch.Tensor:
        return parameter.view_as(parameter)

    def backward(self, diff: torch.Tensor, wanted: bool, sums: Sequence[torch.Tensor], *_: Diff) -> None:
        sums[0].add_(diff)
