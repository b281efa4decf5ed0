"""Exporters of BatchNorm."""

from __future__ import annotations

import torch

from netspec.export.exporter import Exporter, exports
from netspec.export.targets import OnnxGraph, TorchCode, rounded
from netspec.layers.normalization import BatchNorm


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

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        layer = self.layer
        eps = rounded(layer.param.batch_norm_param.eps)
        if not layer.use_global_stats:
            return code.call("F.batch_norm({x}, None, None, training=True, eps={eps})", x=bottoms[0], eps=eps)
        mean, variance = layer.stored_statistics()
        norm = torch_batch_norm(code, len(layer.bottom_shapes[0]), mean, variance, eps)
        return code.call("{norm}({x})", norm=norm, x=bottoms[0])


def torch_batch_norm(
    code: TorchCode, axes: int, mean: torch.Tensor, variance: torch.Tensor, eps: float, **affine: torch.Tensor
) -> str:
    """Add torch's batch normalization by stored statistics; ``affine`` has its weight and bias, or is empty."""
    count = torch.zeros((), dtype=torch.long)
    state = {**affine, "running_mean": mean, "running_var": variance, "num_batches_tracked": count}
    options = ("" if eps == 1e-5 else ", eps={eps}") + ("" if affine else ", affine=False")
    template = f"nn.BatchNorm{max(1, axes - 2)}d({{channels}}{options})"
    numbers = {"channels": len(mean), **({} if eps == 1e-5 else {"eps": eps})}
    return code.module(template, state, **numbers)


def onnx_normalized(graph: OnnxGraph, data: str, axes: int, eps: float) -> str:
    """Write the normalization of a batch: subtract each channel's mean and divide by its standard deviation."""
    centered = graph.node("Sub", data, _onnx_channel_means(graph, data, axes))
    variance = _onnx_channel_means(graph, graph.node("Mul", centered, centered), axes)
    return graph.node("Div", centered, graph.node("Sqrt", graph.node("Add", variance, graph.constant(eps))))


def _onnx_channel_means(graph: OnnxGraph, data: str, axes: int) -> str:
    # One after the other, since means over nonadjacent axes are wrong in OpenCV 5.0.
    for part in ([0], list(range(2, axes))):
        data = graph.node("ReduceMean", data, graph.constant(part), keepdims=1) if part else data
    return data
