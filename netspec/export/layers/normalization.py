"""The expressions of BatchNorm, LRN, MVN."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from netspec.export.exporter import exports, rounded
from netspec.export.expression import Expression, call, with_axes
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.contrast import ACROSS_CHANNELS, LRN, MVN
from netspec.layers.normalization import BatchNorm
from netspec.layers.scale import Scale
from netspec.proto.schema import TEST


@exports(BatchNorm)
def batch_norm(layer: Any, code: TorchCode, x: Expression) -> Expression:
    if not layer.use_global_stats:
        return call(normalize_batch, x, eps=rounded(layer.eps))
    affine = {}
    if is_module(layer) and (scale := code.absorb(lambda after: type(after) is Scale and after.by_channel)):
        weight = scale.blob(0)
        affine = {"weight": weight, "bias": scale.blob(1) if len(scale.blobs) > 1 else torch.zeros_like(weight)}
    return by_statistics(layer, code, x, *layer.stored_statistics(), **affine)


def is_module(layer: Any) -> bool:
    """Return whether the normalization by stored statistics is a module of torch.

    It is none for one axis or six, and none of a training net: in training, it would take the statistics of batches.
    """
    return layer.phase == TEST and 2 <= len(layer.bottom_shapes[0]) <= 5


def by_statistics(
    layer: Any, code: TorchCode, x: Expression, mean: torch.Tensor, variance: torch.Tensor, **affine: torch.Tensor
) -> Expression:
    """Return the normalization by stored statistics; ``affine`` has a module's weight and bias, or is empty."""
    eps = rounded(layer.eps)
    if not is_module(layer):
        only = len(layer.bottom_shapes[0]) == 1
        y = call(F.batch_norm, x[:, None] if only else x, code.buffer(mean), code.buffer(variance), eps=eps)
        return y[:, 0] if only else y
    count = torch.zeros((), dtype=torch.long)
    state = {**affine, "running_mean": mean, "running_var": variance, "num_batches_tracked": count}
    options = {**({} if eps == 1e-5 else {"eps": eps}), **({} if affine else {"affine": False})}
    cls = {4: nn.BatchNorm2d, 5: nn.BatchNorm3d}.get(len(layer.bottom_shapes[0]), nn.BatchNorm1d)
    return code.module(cls, len(mean), state=state, **options)(x)


@exports(LRN)
def lrn(layer: Any, code: TorchCode, x: Expression) -> Expression:
    size, *numbers = layer.settings
    alpha, beta, k = map(rounded, numbers)
    if layer.param.lrn_param.norm_region != ACROSS_CHANNELS:
        return call(spatial_response_norm, x, size, alpha, beta)
    usual = {"alpha": 1e-4, "beta": 0.75, "k": 1.0}
    given = {"alpha": alpha, "beta": beta, "k": k}
    options = {name: number for name, number in given.items() if number != usual[name]}
    return call(F.local_response_norm, x, size, **options)


@exports(MVN)
def mvn(layer: Any, code: TorchCode, x: Expression) -> Expression:
    param = layer.param.mvn_param
    x = with_axes(x, 4 - len(layer.bottom_shapes[0]))
    axes = (1, 2, 3) if param.across_channels else (2, 3)
    if not param.normalize_variance:
        return call(center, x, axes)
    return call(standardize, x, axes, eps=rounded(param.eps))


def batch_mean(x):
    """Return the mean of each channel."""
    mean = x.mean(0, keepdim=True)
    return mean.mean(tuple(range(2, x.dim())), keepdim=True) if x.dim() > 2 else mean


def normalize_batch(x, eps):
    """Subtract each channel's mean over the batch and divide by the standard deviation."""
    x = x - batch_mean(x)
    return x / (batch_mean(x.square()) + eps).sqrt()


def spatial_response_norm(x, size, alpha, beta):
    """Divide by a power of 1 + alpha times the mean square of size x size pixels."""
    mean = F.avg_pool2d(x * x, size, stride=1, padding=size // 2)
    return x / (1 + alpha * mean).pow(beta)


def center(x, axes):
    """Subtract the mean over some axes."""
    return x - x.mean(axes, keepdim=True)


def standardize(x, axes, eps):
    """Subtract the mean over some axes and divide by the standard deviation plus eps."""
    x = center(x, axes)
    return x / (root(x.square().mean(axes, keepdim=True), eps) + eps)


def root(x, least):
    """Return the square root; its gradient is 1 / 2 (root + least), which is finite at 0."""
    at = x.detach()
    return at.sqrt() + (x - at) / (2 * (at.sqrt() + least))
