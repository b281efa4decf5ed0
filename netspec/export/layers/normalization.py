"""Exporters of BatchNorm."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from netspec.export.exporter import Exporter, exports, rounded
from netspec.export.expression import Expression, Submodule, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.normalization import BatchNorm
from netspec.layers.scale import Scale


@exports(BatchNorm)
class BatchNormExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        eps = layer.param.batch_norm_param.eps
        if not layer.use_global_stats:
            return onnx_normalized(graph, bottoms[0], len(layer.bottom_shapes[0]), eps)
        ones, zeros = torch.ones(layer.channels), torch.zeros(layer.channels)
        constants = [graph.constant(values) for values in (ones, zeros, *layer.stored_statistics())]
        return graph.node("BatchNormalization", *bottoms, *constants, epsilon=eps)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        eps = rounded(layer.param.batch_norm_param.eps)
        if not layer.use_global_stats:
            return call(F.batch_norm, x, None, None, training=True, eps=eps)
        affine = self.affine(code)
        mean, variance = layer.stored_statistics()
        return torch_batch_norm(code, len(layer.bottom_shapes[0]), mean, variance, eps, **affine)(x)

    def affine(self, code: TorchCode) -> dict[str, torch.Tensor]:
        """Return the weight and bias of the module, those of a Scale that alone reads the top, or nothing."""
        scale = code.absorb(lambda after: type(after) is Scale and after.by_channel)
        if scale is None:
            return {}
        weight = scale.blob(0)
        return {"weight": weight, "bias": scale.blob(1) if len(scale.blobs) > 1 else torch.zeros_like(weight)}


def torch_batch_norm(
    code: TorchCode, axes: int, mean: torch.Tensor, variance: torch.Tensor, eps: float, **affine: torch.Tensor
) -> Submodule:
    """Return torch's batch normalization by stored statistics; ``affine`` has its weight and bias, or is empty."""
    count = torch.zeros((), dtype=torch.long)
    state = {**affine, "running_mean": mean, "running_var": variance, "num_batches_tracked": count}
    options = {**({} if eps == 1e-5 else {"eps": eps}), **({} if affine else {"affine": False})}
    cls = (nn.BatchNorm1d, nn.BatchNorm1d, nn.BatchNorm1d, nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d)[axes]
    return code.module(cls, len(mean), state=state, **options)


def onnx_normalized(graph: OnnxGraph, data: str, axes: int, eps: float) -> str:
    """Write the normalization of a batch: subtract each channel's mean and divide by its standard deviation."""
    centered = graph.node("Sub", data, _onnx_channel_means(graph, data, axes))
    variance = _onnx_channel_means(graph, graph.node("Mul", centered, centered), axes)
    return graph.node("Div", centered, graph.node("Sqrt", graph.node("Add", variance, graph.constant(eps))))


def _onnx_channel_means(graph: OnnxGraph, data: str, axes: int) -> str:
    # One after the other, since means over nonadjacent axes are wrong in OpenCV 5.0.
    for part in ([0], list(range(2, axes))):
        data = graph.node("ReduceMean", data, axes=part, keepdims=1) if part else data
    return data
