"""Functions whose ONNX nodes are written here, because torch.onnx has none for them, or others than readers know.

A function that torch does not have either is an operator of torch.library, for which torch.export needs only the shape
of the result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch


@torch.library.custom_op("netspec::max_roi_pool", mutates_args=())
def max_roi_pool(x: torch.Tensor, regions: torch.Tensor, bins: list[int], scale: float) -> torch.Tensor:
    """Return the maxima of the bins of regions (R, 5): item and corners. Only ONNX has it: MaxRoiPool."""
    raise NotImplementedError


@max_roi_pool.register_fake
def _(x: torch.Tensor, regions: torch.Tensor, bins: list[int], scale: float) -> torch.Tensor:
    return x.new_empty(regions.shape[0], x.shape[1], *bins)


@torch.library.custom_op("netspec::suppressed", mutates_args=())
def suppressed(boxes: torch.Tensor, overlap: float) -> torch.Tensor:
    """Return which boxes (B, K, 4), in this order, overlap one kept before: NonMaxSuppression."""
    raise NotImplementedError


@suppressed.register_fake
def _(boxes: torch.Tensor, overlap: float) -> torch.Tensor:
    return boxes.new_empty(boxes.shape[:2], dtype=torch.bool)


def translations() -> dict[Callable[..., Any], Callable[..., Any]]:
    """Return the functions that write the nodes, by the operator of torch, as ``torch.onnx.export`` takes them."""
    import onnxscript

    op: Any = onnxscript.opset18

    def sort(x: Any, stable: bool = False, dim: int = -1, descending: bool = False) -> Any:
        """TopK has the first of equal values first."""
        count = op.Gather(op.Shape(x), op.Constant(value_ints=[dim]), axis=0)
        return op.TopK(x, count, axis=dim, largest=int(descending), sorted=1)

    def write_suppressed(boxes: Any, overlap: float) -> Any:
        """The scores fall, so that each box is kept or suppressed in its order.

        ONNX takes the corners in any order; in Caffe, a box that is turned inside out overlaps nothing. OpenCV 5 takes
        no scores below 0.
        """
        low, high = op.Split(boxes, axis=2, num_outputs=2)
        areas = op.Concat(low, op.Max(low, high), axis=2)
        shape = op.Shape(boxes, start=0, end=2)
        count = op.Shape(boxes, start=1, end=2)
        zero, one = op.Constant(value_int=0), op.Constant(value_int=1)
        falling = op.Cast(op.Sub(count, op.Range(zero, op.Squeeze(count), one)), to=1)
        scores = op.Unsqueeze(op.Expand(falling, shape), op.Constant(value_ints=[1]))
        limits = op.Constant(value_floats=[overlap]), op.Constant(value_floats=[0.0])
        kept = op.NonMaxSuppression(areas, scores, count, *limits)
        places = op.Gather(kept, op.Constant(value_ints=[0, 2]), axis=1)
        ones = op.Expand(op.Constant(value_float=1.0), shape)
        zeros = op.Expand(op.Constant(value_float=0.0), op.Shape(kept, start=0, end=1))
        return op.Greater(op.ScatterND(ones, places, zeros), op.Constant(value_float=0.5))

    def max_pool(
        x: Any, kernel: Any, stride: Any = (), padding: Any = 0, dilation: Any = 1, ceil_mode: bool = False
    ) -> Any:
        windows, _ = _windows(kernel, stride, padding, ceil_mode)
        return op.MaxPool(x, **windows)[0]

    def avg_pool(
        x: Any, kernel: Any, stride: Any = (), padding: Any = 0, ceil_mode: bool = False, *others: Any, **more: Any
    ) -> Any:
        """Divide by the area of each window within the padded map."""
        windows, beyond = _windows(kernel, stride, padding, ceil_mode)
        means = op.AveragePool(x, count_include_pad=1, **windows)
        if not any(beyond):
            return means
        ones = op.Expand(op.Constant(value_float=1.0), op.Shape(x))
        pads = windows["pads"][:2]
        frame = op.Constant(value_ints=[0, 0, *pads, 0, 0, *pads])
        padded = op.Pad(ones, frame, op.Constant(value_float=1.0)) if any(pads) else ones
        return op.Div(means, op.AveragePool(padded, count_include_pad=1, **{**windows, "pads": [0, 0, *beyond]}))

    def write_max_roi_pool(x: Any, regions: Any, bins: Any, scale: float) -> Any:
        return op.MaxRoiPool(x, regions, pooled_shape=bins, spatial_scale=scale)

    return {
        torch.ops.aten.sort.stable: sort,
        torch.ops.aten.max_pool2d.default: max_pool,
        torch.ops.aten.avg_pool2d.default: avg_pool,
        torch.ops.netspec.max_roi_pool.default: write_max_roi_pool,
        torch.ops.netspec.suppressed.default: write_suppressed,
    }


def _windows(kernel: Any, stride: Any, padding: Any, ceil_mode: bool) -> tuple[dict[str, list[int]], list[int]]:
    """Return the attributes of an ONNX pool, and what its windows reach beyond the padding.

    Readers round up differently. With these pads after the map, rounding down gives torch's windows at every size.
    """
    kernel, stride, padding = (
        list(each) if isinstance(each, Sequence) else [each] for each in (kernel, stride, padding)
    )
    kernel, padding = (each * 2 if len(each) == 1 else each for each in (kernel, padding))
    stride = stride * 2 if len(stride) == 1 else stride or kernel
    axes = list(zip(kernel, stride, padding, strict=True))
    ends = [max(p, min(p + s - 1, k - 1)) if ceil_mode else p for k, s, p in axes]
    windows = {"kernel_shape": kernel, "strides": stride, "pads": [*padding, *ends]}
    return windows, [end - p for end, p in zip(ends, padding, strict=True)]
