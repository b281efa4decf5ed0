"""Kernels of losses (netspec/layers/loss)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from netspec.exact import SMALL_ITEM
from netspec.exact.losses import softmax
from netspec.fast.entry import Entry
from netspec.fast.kernels import Learning
from netspec.layers.loss.base import normalizer
from netspec.layers.loss.scores import FLT_MIN, SoftmaxWithLoss
from netspec.run.recorded import Kernels


def _learn_softmax(layer: SoftmaxWithLoss, how: Learning) -> Kernels | None:
    """Return the kernels, or None if a label may be ignored."""
    if layer.ignore_label is not None or math.prod(layer.bottom_shapes[0]) == 0:
        return None
    shape, tops = layer.bottom_shapes[0], layer.num_tops
    split, flat = (layer.outer, layer.classes, layer.inner), (layer.outer, 1, layer.inner)
    divisor = float(normalizer(layer.normalization, layer.outer, layer.inner, None))
    exact = layer.arithmetic(torch.empty(1), small=math.prod(split[1:]) <= SMALL_ITEM).is_caffes
    label, diff = torch.empty(flat, dtype=torch.long), torch.empty(split)
    normalize = softmax if exact else partial(F.softmax, dim=1)
    sum_up = _prepared_cross_entropy(split, FLT_MIN, divisor) if exact else lambda p, _: _mean(p, label, divisor)
    # Numpy works on p and its gradient, because its calls have less overhead than torch's.
    p, classes, found = torch.empty(0), label.numpy().reshape(-1), diff.numpy()
    unsigned, starts = classes.view(np.uint64), np.arange(layer.outer * layer.inner)
    starts += (layer.classes - 1) * layer.inner * (starts // layer.inner)  # where the first class is
    places, diffs, by = np.empty_like(starts), found.reshape(-1), np.float32(divisor)

    def forward(scores: torch.Tensor, labels: torch.Tensor) -> Any:
        nonlocal p
        label.copy_(labels.reshape(flat))
        if np.maximum.reduce(unsigned) >= split[1]:
            layer.valid(label, None)
        p = normalize(scores.reshape(split))
        np.add(starts, classes if split[2] == 1 else classes * split[2], places)
        return (sum_up(p, places), p.reshape(shape))[:tops]

    def backward(top_diff: torch.Tensor, *_: Any) -> tuple[torch.Tensor, None]:
        np.copyto(found, p.numpy())
        diffs[places] -= 1
        np.multiply(found, np.float32(top_diff.item()) / by, found)
        return diff.view(shape), None

    return Kernels(forward, backward)


def _mean(p: torch.Tensor, label: torch.Tensor, divisor: float) -> torch.Tensor:
    return (-p.gather(1, label).clamp_(min=FLT_MIN).log()).sum() / divisor


def _prepared_cross_entropy(
    shape: tuple[int, int, int], least: float, divisor: float
) -> Callable[[torch.Tensor, np.ndarray], torch.Tensor]:
    """Return a function of p, float32 of this shape, and of the positions of the labels' probabilities in it.

    It returns the sum of -log(max(probability, least)) / ``divisor`` as a scalar, added one by one as in Caffe.
    """
    one, loss = torch.ones(()), torch.empty(())
    chosen, logs = torch.empty(2, shape[0] * shape[2])
    few, values, result, by = chosen.numpy(), logs.numpy(), loss.numpy(), np.float32(divisor)

    def run(p: torch.Tensor, places: np.ndarray) -> torch.Tensor:
        p.numpy().reshape(-1).take(places, out=few, mode="clip")
        chosen.clamp_(min=least)
        torch.special.xlogy(one, chosen, out=logs)  # see libm.log
        result[()] = -np.add.accumulate(values)[-1] / by
        return loss

    return run


ENTRIES = {
    SoftmaxWithLoss: Entry(learning=_learn_softmax),
}
