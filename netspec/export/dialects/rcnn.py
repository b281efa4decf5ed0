"""The expressions of layers of netspec/dialects/rcnn."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F

from netspec.export.exporter import exports, refusal, rounded
from netspec.export.expression import Expression, call
from netspec.export.formats.nodes import max_roi_pool
from netspec.export.formats.torch_code import TorchCode


@exports("netspec.dialects.rcnn.rcnn.ROIPooling")
def roi_pooling(layer: Any, code: TorchCode, x: Expression, regions: Expression) -> Expression:
    if not code.onnx:
        raise refusal(layer, "PyTorch has no pooling of regions; torchvision's roi_pool is near to it")
    if layer.pad_ratio:
        raise refusal(layer, "its regions grow by pad_ratio")
    return call(max_roi_pool, x, regions.reshape(-1, 5), list(layer.bins), float(layer.scale))


@exports("netspec.dialects.rcnn.smooth.SmoothL1Loss")
def smooth_l1(layer: Any, code: TorchCode, x: Expression, *others: Expression) -> Expression:
    if layer.by_pixel:
        raise refusal(layer, "R-FCN's loss is for training")
    same = [shape == layer.bottom_shapes[0] for shape in layer.bottom_shapes[1:]]
    aligned = [y if fits else y.reshape(x.shape) for y, fits in zip(others, same, strict=True)]
    return call(weighted_smooth_l1_loss, x, *aligned, beta=rounded(layer.knee))


def weighted_smooth_l1_loss(predictions, targets, inside=1.0, outside=1.0, beta=1.0):
    """Return the weighted sum of the smooth L1 losses of the differences, which may be weighted too, divided by N."""
    difference = inside * (predictions - targets)
    zeros = torch.zeros_like(difference)
    losses = F.smooth_l1_loss(difference, zeros, beta=beta, reduction="none")
    return (outside * losses).sum() / predictions.shape[0]
