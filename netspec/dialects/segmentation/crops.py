"""Crop without crop_param, which aligns its bottoms in some forks, while Caffe crops from the corner.

Pixel i of the top of a convolution with kernel k, stride s and pad p is at s i + (k - 1) / 2 - p in its bottom; for a
deconvolution, it is the inverse. HED's branch, and nets that follow it (OSVOS, early fcn-8s), crop so that the
pixels of both bottoms are aligned.
Fork: s9xie/hed, src/caffe/layers/crop_layer.cpp. The rule became BVLC's python/caffe/coord_map.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any

from netspec.graph.plan import Plan
from netspec.proto.schema import LayerParameter, NetParameter

Line = tuple[Fraction, Fraction]  # (scale, shift): pixel i is at scale i + shift
SAME = (Fraction(1), Fraction(0))
ELEMENTWISE = (
    "AbsVal",
    "BatchNorm",
    "Bias",
    "BN",
    "BNLL",
    "Clip",
    "Dropout",
    "Eltwise",
    "ELU",
    "Exp",
    "Log",
    "LRN",
    "MVN",
    "Power",
    "PReLU",
    "ReLU",
    "ReLU6",
    "Scale",
    "Sigmoid",
    "Split",
    "Swish",
    "TanH",
    "Threshold",
)
HED = "hed"
CORNER = (
    "without crop_param it cuts from the corner, as in Caffe; HED's branch aligns its bottoms, by {by}: for that "
    'write "# dialect: hed" into the prototxt or pass --plugin hed'
)
ALIGNED = (
    "without crop_param it aligns its bottoms as HED's branch does, by {by}, since a convolution before it pads with "
    "more than its kernel; Caffe cuts from the corner: for that write crop_param {{ axis: 2 offset: 0 }}"
)
EDGES = (
    "; SigmoidCrossEntropyLoss is computed as in Caffe; for that of HED or RCF, which weights edges, name the dialect"
)


def with_aligned_crops(plan: Plan) -> Plan:
    """Return a plan whose Crops without crop_param have offsets where HED's branch is meant, with warnings."""
    if not any(layer.type == "Crop" for layer in plan.net.layer):
        return plan
    net = NetParameter()
    net.CopyFrom(plan.net)
    aligned = replace(plan, net=net)
    return replace(aligned, warnings=tuple(_align(aligned)))


def _align(plan: Plan) -> Iterator[str]:
    """Set the offsets of each Crop without crop_param as in HED's branch, if the net is made for it; yield warnings.

    It is if the dialect is named, or if a convolution before the Crop has more padding than its kernel, because only
    such a Crop removes the surplus.
    """
    makers = {value: i for i, node in enumerate(plan.nodes) for value in node.tops}
    found: dict[str, list[int]] = {}
    by: dict[int, str] = {}
    for i, layer in enumerate(plan.net.layer):
        if layer.type != "Crop" or layer.HasField("crop_param") or len(layer.bottom) != 2:
            continue
        offsets, padded = _offsets(plan, makers, i) or ([], False)
        if any(offsets) and (padded or HED in plan.dialects):
            layer.crop_param.axis = 2
            layer.crop_param.offset.extend(offsets)
        if any(offsets) and HED not in plan.dialects:
            found.setdefault(ALIGNED if padded else CORNER, []).append(i)
            by.setdefault(i, " and ".join(map(str, offsets)))
    for message, crops in found.items():
        where = plan.source.at(crops[0], layer=plan.nodes[crops[0]].name, type="Crop")
        others = f" (also in {len(crops) - 1} more of these layers)" if len(crops) > 1 else ""
        edges = any(layer.type == "SigmoidCrossEntropyLoss" for layer in plan.net.layer) and "rcf" not in plan.dialects
        yield f"{where}: {message.format(by=by[crops[0]])}{others}{EDGES if edges else ''}"


def _offsets(plan: Plan, makers: dict[int, int], crop: int) -> tuple[list[int], bool] | None:
    """Return the offsets of a Crop's rows and columns, and whether a convolution pads beyond its kernel.

    None if the bottoms are not connected, have different scales, or if the offset is not a whole number of pixels.
    """
    first, second = (_ancestors(plan, makers, value) for value in plan.nodes[crop].bottoms)
    common = next((value for value in second if value in first), None)
    if common is None:
        return None
    offsets, padded = [], False
    for axis in (0, 1):
        lines = []
        for way in (first, second):
            line: Line | None = SAME
            for value, maker in way.items():
                if value == common or line is None:
                    break
                line, beyond = _line_below(plan.net.layer[maker], axis, line)
                padded = padded or beyond
            lines.append(line)
        if lines[0] is None or lines[1] is None or lines[0][0] != lines[1][0]:
            return None
        offset = (lines[1][1] - lines[0][1]) / lines[0][0]
        if offset < 0 or offset.denominator != 1:
            return None
        offsets.append(int(offset))
    return offsets, padded


def _ancestors(plan: Plan, makers: dict[int, int], value: int) -> dict[int, int]:
    """Return the ancestors of a value, by first bottoms, and the layers that compute them; -1 for an input."""
    way: dict[int, int] = {}
    while value >= 0:
        maker = makers.get(value, -1)
        way[value] = maker
        bottoms = plan.nodes[maker].bottoms if maker >= 0 else ()
        value = bottoms[0] if bottoms else -1
    return way


def _line_below(layer: LayerParameter, axis: int, line: Line) -> tuple[Line | None, bool]:
    """Return the (scale, shift) of a layer's bottom from that of its top, and whether it pads beyond its kernel."""
    scale, shift = line
    if layer.type in ELEMENTWISE:
        return line, False
    if layer.type == "Crop":
        param, rows = layer.crop_param, 2 + axis - layer.crop_param.axis
        offsets = list(param.offset) or [0]
        offset = 0 if rows < 0 or param.axis < 0 else offsets[rows if len(offsets) > rows else 0]
        return (scale, shift + offset), False
    if layer.type in ("Convolution", "DepthwiseConvolution", "ConvolutionDepthwise", "Deconvolution"):
        param: Any = layer.convolution_param
        kernel, stride, pad, dilation = (_of(param, name, axis) for name in ("kernel", "stride", "pad", "dilation"))
        kernel = (kernel - 1) * dilation + 1
    elif layer.type == "Pooling" and not layer.pooling_param.global_pooling:
        kernel, stride, pad = (_of(layer.pooling_param, name, axis) for name in ("kernel", "stride", "pad"))
    else:
        return None, False
    middle = Fraction(kernel - 1, 2) - pad
    if layer.type == "Deconvolution":
        return (scale / stride, (shift - middle) / stride), False
    return (scale * stride, shift * stride + middle), pad >= kernel


def _of(param: Any, name: str, axis: int) -> int:
    """Return a size of a convolution or pooling along rows (0) or columns (1)."""
    single = "kernel_size" if name == "kernel" else name
    own = f"{name}_{'hw'[axis]}"
    if own in param.DESCRIPTOR.fields_by_name and param.HasField(own):
        return getattr(param, own)
    values = getattr(param, single)
    if isinstance(values, int):
        return max(values, 0 if name == "pad" else 1)
    return values[min(axis, len(values) - 1)] if values else 0 if name == "pad" else 1
