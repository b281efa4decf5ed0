"""Exporters of layers of netspec/dialects/rcnn."""

from __future__ import annotations

import torch.nn.functional as F

from netspec.export.exporter import Exporter, exports, rounded
from netspec.export.expression import Expression, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.export.layers.loss import onnx_normalized_sum
from netspec.layers.loss.base import BATCH_SIZE


@exports("netspec.dialects.rcnn.rcnn.ROIPooling")
class ROIPoolingExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        if layer.pad_ratio:
            raise self.refusal("ONNX", "its regions grow by pad_ratio")
        regions = graph.reshape(bottoms[1], [-1, 5])
        return graph.node("MaxRoiPool", bottoms[0], regions, pooled_shape=layer.bins, spatial_scale=layer.scale)


@exports("netspec.dialects.rcnn.smooth.SmoothL1Loss")
class SmoothL1LossExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        if layer.by_pixel:
            raise self.refusal("ONNX", "R-FCN's loss is for training")
        predictions, *others = bottoms
        shape = graph.shape_of(predictions)
        aligned = [
            bottom if layer.bottom_shapes[i] == layer.bottom_shapes[0] else graph.node("Reshape", bottom, shape)
            for i, bottom in enumerate(others, 1)
        ]
        difference = graph.node("Sub", predictions, aligned[0])
        if len(aligned) > 1:
            difference = graph.node("Mul", difference, aligned[1])
        length = graph.node("Abs", difference)
        knee = graph.constant(layer.knee)
        square = graph.node("Mul", graph.node("Mul", difference, difference), graph.constant(0.5 / layer.knee))
        linear = graph.node("Sub", length, graph.constant(0.5 * layer.knee))
        losses = graph.node("Where", graph.node("Less", length, knee), square, linear)
        if len(aligned) > 2:
            losses = graph.node("Mul", losses, aligned[2])
        return onnx_normalized_sum(graph, losses, "", BATCH_SIZE)

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Expression:
        layer = self.layer
        if len(set(layer.bottom_shapes)) > 1 or layer.by_pixel:
            raise self.refusal("PyTorch", "it is exported for bottoms of one shape, and not as R-FCN's")
        return call(weighted_smooth_l1_loss, *bottoms, beta=rounded(layer.knee))


def weighted_smooth_l1_loss(predictions, targets, inside=1.0, outside=1.0, beta=1.0):
    """Return the weighted sum of the smooth L1 losses of the differences, which may be weighted too, divided by N."""
    x, y = inside * predictions, inside * targets
    losses = F.smooth_l1_loss(x, y, beta=beta, reduction="none")
    return (outside * losses).sum() / predictions.shape[0]
