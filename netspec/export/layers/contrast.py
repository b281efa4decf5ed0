"""Exporters of LRN, MVN."""

from __future__ import annotations

import torch
from torch.nn import functional as F

from netspec.export.exporter import Exporter, exports, rounded
from netspec.export.expression import Expression, call, with_axes
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.contrast import ACROSS_CHANNELS, LRN, MVN


@exports(LRN)
class LRNExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        param = self.layer.param.lrn_param
        size, reach = param.local_size, param.local_size // 2
        if param.norm_region == ACROSS_CHANNELS:
            if param.k == int(param.k):
                return graph.node("LRN", *bottoms, size=size, alpha=param.alpha, beta=param.beta, bias=param.k)
            # OpenVINO 2026.4 rounds k down.
            top = graph.node("LRN", *bottoms, size=size, alpha=param.alpha / param.k, beta=param.beta, bias=1.0)
            return graph.node("Mul", top, graph.constant(param.k**-param.beta))
        squares = graph.node("Mul", *bottoms, *bottoms)
        window = {"kernel_shape": [size] * 2, "pads": [reach] * 4, "count_include_pad": 1}
        mean = graph.node("Mul", graph.node("AveragePool", squares, **window), graph.constant(param.alpha))
        base = graph.node("Add", mean, graph.constant(1.0))
        return graph.node("Mul", *bottoms, graph.node("Pow", base, graph.constant(-param.beta)))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        param = self.layer.param.lrn_param
        alpha, beta = rounded(param.alpha), rounded(param.beta)
        if param.norm_region != ACROSS_CHANNELS:
            return call(spatial_response_norm, x, param.local_size, alpha, beta)
        usual = {"alpha": 1e-4, "beta": 0.75, "k": 1.0}
        given = {"alpha": alpha, "beta": beta, "k": rounded(param.k)}
        options = {name: number for name, number in given.items() if number != usual[name]}
        return call(F.local_response_norm, x, param.local_size, **options)


@exports(MVN)
class MVNExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        param, (data,) = self.layer.param.mvn_param, bottoms
        missing = list(range(len(self.layer.bottom_shapes[0]), 4))
        if missing:
            data = graph.node("Unsqueeze", data, graph.constant(missing))
        axes = list(range(1 if param.across_channels else 2, 4))
        top = graph.node("Sub", data, graph.node("ReduceMean", data, axes=axes, keepdims=1))
        if not param.normalize_variance:
            return top
        variance = graph.node("ReduceMean", graph.node("Mul", top, top), axes=axes, keepdims=1)
        return graph.node("Div", top, graph.node("Add", graph.node("Sqrt", variance), graph.constant(param.eps)))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        param = self.layer.param.mvn_param
        x = with_axes(x, 4 - len(self.layer.bottom_shapes[0]))
        axes = (1, 2, 3) if param.across_channels else (2, 3)
        if not param.normalize_variance:
            return call(center, x, axes)
        return call(standardize, x, axes, eps=rounded(param.eps))


def spatial_response_norm(x, size, alpha, beta):
    """Divide by a power of 1 + alpha times the mean square of size x size pixels."""
    mean = F.avg_pool2d(x * x, size, stride=1, padding=size // 2)
    return x / (1 + alpha * mean).pow(beta)


def center(x, axes):
    """Subtract the mean over some axes."""
    return x - x.mean(axes, keepdim=True)


def standardize(x, axes, eps):
    """Subtract the mean over some axes and divide by the standard deviation plus eps."""
    variance, mean = torch.var_mean(x, axes, correction=0, keepdim=True)
    return (x - mean) / (variance.sqrt() + eps)
