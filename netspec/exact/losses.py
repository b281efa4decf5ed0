"""Losses of single items, with Caffe's gradients. netspec/exact/sums.py adds them up."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

from typing import Any

import torch
from torch.autograd.function import once_differentiable

from netspec.exact import libm
from netspec.exact.blas import add_sums, dots, one_thread, sum_in_order
from netspec.exact.pointwise import pointwise


@one_thread()
def softmax(scores: torch.Tensor) -> torch.Tensor:
    """Return the softmax along axis 1 of scores (outer, classes, inner) (src/caffe/layers/softmax_layer.cpp)."""
    p = libm.exp(scores - scores.amax(1, keepdim=True))
    sums = p.new_zeros(p.shape[0], p.shape[2])
    add_sums(p, sums, axis=0)
    return p.div_(sums.unsqueeze(1))


def softmax_gradient(p: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
    """Return the gradient of the scores from that of their softmax p, both (outer, classes, inner)."""
    return (diff - dots(diff, p).unsqueeze(1)) * p


def sigmoid_cross_entropy(x: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the cross entropy of sigmoid(x) and the target, of each number.

    Caffe: src/caffe/layers/sigmoid_cross_entropy_loss_layer.cpp
    """

    def compute(x: torch.Tensor) -> torch.Tensor:
        positive = (x >= 0).to(x.dtype)
        return libm.log(1 + libm.exp(x - 2 * x * positive)) - x * (target - positive)

    return pointwise(x, compute, lambda x, _, diff: (libm.sigmoid(x) - target) * diff)


class Infogain(torch.autograd.Function):
    """Return -gain log(p) of each class and p, the softmax of the scores.

    scores   (outer, classes, inner)
    gain     (outer, inner, classes): the row of the infogain matrix for each label
    returns  (outer, inner, classes) and (outer, classes, inner)

    Caffe: src/caffe/layers/infogain_loss_layer.cpp
    """

    @staticmethod
    def forward(ctx: Any, scores: torch.Tensor, gain: torch.Tensor, least: float) -> tuple[torch.Tensor, torch.Tensor]:
        p = softmax(scores)
        ctx.save_for_backward(p, gain)
        ctx.mark_non_differentiable(p)
        return -gain * libm.log(p.clamp(min=least).movedim(1, 2)), p

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, diff: torch.Tensor, *_: Any) -> tuple[torch.Tensor, None, None]:
        """Return the gradient of the scores, for losses that are summed up. It ignores ``least``."""
        p, gain = ctx.saved_tensors
        of_scores = p.movedim(1, 2) * sum_in_order(gain, 2).unsqueeze(2) - gain
        return (of_scores * diff).movedim(2, 1), None, None
