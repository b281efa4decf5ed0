"""Crop without crop_param: HED's branch aligns its bottoms, while Caffe crops from the corner.

Nets that follow HED (OSVOS, early fcn-8s) crop so that the pixels of both bottoms are aligned.
Fork: s9xie/hed, src/caffe/layers/crop_layer.cpp. The rule became BVLC's python/caffe/coord_map.py.
"""

from __future__ import annotations

from collections.abc import Collection
from fractions import Fraction
from typing import Any

from netspec.graph.coordinates import PASS_THROUGH_LAYERS, inverted, of_windows
from netspec.proto.schema import LayerParameter, NetParameter
from netspec.proto.source_map import SourceMap

Line = tuple[Fraction, Fraction]  # (scale, shift): pixel i of an ancestor is at scale i + shift in the Crop's bottom
Value = tuple[int, str]  # the index of the layer that makes it, and its name
SAME = (Fraction(1), Fraction(0))
CONVOLUTIONS = ("Convolution", "DepthwiseConvolution", "ConvolutionDepthwise", "Deconvolution")
HED = "hed"
CORNER = (
    "without crop_param it cuts from the corner, as in Caffe; HED's branch aligns its bottoms, by {by}, and weights "
    'the edges of SigmoidCrossEntropyLoss: for these write "# dialect: hed" into the prototxt, or pass --plugin hed'
)


def with_aligned_crops(
    net: NetParameter, source: SourceMap, dialects: Collection[str]
) -> tuple[NetParameter, list[str]]:
    """Return a net whose Crops without crop_param are aligned if it is HED's, and a warning if others would be."""
    if not any(layer.type == "Crop" and not layer.HasField("crop_param") for layer in net.layer):
        return net, []
    aligned = NetParameter()
    aligned.CopyFrom(net)
    crops = _align(aligned)
    if HED in dialects or not crops:
        return aligned, []
    where = source.at(crops[0], layer=net.layer[crops[0]].name, type="Crop")
    by = " and ".join(map(str, aligned.layer[crops[0]].crop_param.offset))
    others = f" (also in {len(crops) - 1} more of these layers)" if len(crops) > 1 else ""
    return net, [f"{where}: {CORNER.format(by=by)}{others}"]


def _align(net: NetParameter) -> list[int]:
    """Set the offsets in rows and columns at which Crops without crop_param are aligned; return the indices of these.

    Those are left out whose bottoms are not connected, have different scales or no whole number of pixels between them.
    """
    newest: dict[str, Value] = {}
    below: dict[Value, Value | None] = {}  # the first bottom of the layer that makes a value
    found = []
    for i, layer in enumerate(net.layer):
        bottoms = [newest.get(name) for name in layer.bottom]
        if layer.type == "Crop" and not layer.HasField("crop_param") and len(bottoms) == 2:
            first, second = (_lines(net, below, bottom) for bottom in bottoms)
            common = next((value for value in second if value in first), None)
            offsets = [_between(*lines) for lines in zip(first[common], second[common], strict=True)] if common else []
            if any(offsets) and None not in offsets:
                layer.crop_param.axis = 2
                layer.crop_param.offset.extend(offset for offset in offsets if offset is not None)
                found.append(i)
        for name in layer.top:
            below[i, name] = bottoms[0] if bottoms else None
            newest[name] = (i, name)
    return found


def _between(first: Line, second: Line) -> int | None:
    """Return how far the second bottom of a Crop lies inside the first, if it does, by whole pixels."""
    offset = first[1] - second[1]
    return int(offset) if first[0] == second[0] and offset >= 0 and offset.denominator == 1 else None


def _lines(net: NetParameter, below: dict[Value, Value | None], value: Value | None) -> dict[Value, tuple[Line, Line]]:
    """Return the ancestors of a value by first bottoms, with their lines along rows and columns."""
    lines: list[Line] = [SAME, SAME]
    found: dict[Value, tuple[Line, Line]] = {}
    while value:
        found[value] = (lines[0], lines[1])
        layer, value = net.layer[value[0]], below[value]
        for axis, (scale, shift) in enumerate(lines):
            step = _step(layer, axis)
            if step is None:
                return found
            lines[axis] = scale * step[0], scale * step[1] + shift
    return found


def _step(layer: LayerParameter, axis: int) -> Line | None:
    """Return the line from a layer's bottom to its top, None if it has none."""
    if layer.type in PASS_THROUGH_LAYERS:
        return SAME
    if layer.type == "Crop":
        param, rows = layer.crop_param, 2 + axis - layer.crop_param.axis
        offsets = list(param.offset) or [0]
        return Fraction(1), Fraction(0 if rows < 0 or param.axis < 0 else -offsets[rows if len(offsets) > rows else 0])
    if layer.type in CONVOLUTIONS:
        param: Any = layer.convolution_param
        kernel, stride, pad, dilation = (_of(param, name, axis) for name in ("kernel", "stride", "pad", "dilation"))
        step = of_windows(stride, (kernel - 1) * dilation + 1, pad)
        return inverted(*step) if layer.type == "Deconvolution" else step
    if layer.type == "Pooling" and not layer.pooling_param.global_pooling:
        return of_windows(*(_of(layer.pooling_param, name, axis) for name in ("stride", "kernel", "pad")))
    return None


def _of(param: Any, name: str, axis: int) -> Fraction:
    """Return a size of a convolution or pooling along rows (0) or columns (1)."""
    single = "kernel_size" if name == "kernel" else name
    own = f"{name}_{'hw'[axis]}"
    if own in param.DESCRIPTOR.fields_by_name and param.HasField(own):
        return Fraction(getattr(param, own))
    values, least = getattr(param, single), 0 if name == "pad" else 1
    if isinstance(values, int):
        return Fraction(max(values, least))
    return Fraction(values[min(axis, len(values) - 1)] if values else least)
