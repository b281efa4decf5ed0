"""The cost of a layer as OpenCV counts it: operations of one forward pass.

OpenCV: getFLOPS of the classes in modules/dnn/src/layers (4.12); layers that it does not count cost 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from netspec.layers.contract.base import Layer, Shape

_MAX = 0  # caffe.proto: PoolingParameter.PoolMethod
_WITHIN_CHANNEL = 1  # caffe.proto: LRNParameter.NormRegion

#: Operations per element of the first bottom.
_FOR_EACH = {
    "AbsVal": 1,
    "BNLL": 5,
    "BatchNorm": 3,
    "ELU": 2,
    "Exp": 3,
    "Log": 1,
    "PReLU": 1,
    "ReLU": 1,
    "ReLU6": 2,
    "Sigmoid": 3,
    "Softmax": 4,
    "Swish": 3,
    "TanH": 1,
}


def operations(layer: Layer) -> int:
    """Return the number of operations of a layer at its current shapes."""
    count = _COUNTS.get(layer.type)
    if count is not None:
        return count(layer)
    return _FOR_EACH.get(layer.type, 0) * math.prod(layer.bottom_shapes[0] if layer.bottom_shapes else ())


def _convolution(layer: Layer) -> int:
    kernel = math.prod(layer.blob_shapes[0][2:])
    bottoms = zip(layer.bottom_shapes, layer.top_shapes, strict=True)
    return sum(math.prod(top) * (2 * kernel * bottom[1] + 1) for bottom, top in bottoms)


def _deconvolution(layer: Layer) -> int:
    channels, _, *kernel = layer.blob_shapes[0]  # OpenCV uses the number of channels of the bottom instead of the top
    return sum(2 * channels * math.prod(kernel) * math.prod(bottom) for bottom in layer.bottom_shapes)


def _inner_product(layer: Layer) -> int:
    outputs = layer.param.inner_product_param.num_output
    return 3 * (math.prod(layer.blob_shapes[0]) // outputs) * math.prod(layer.top_shapes[0])


def _pooling(layer: Layer) -> int:
    param = layer.param.pooling_param
    height, width = param.kernel_h or param.kernel_size, param.kernel_w or param.kernel_size
    pixels = math.prod(layer.bottom_shapes[0][2:]) if param.global_pooling else height * width
    return math.prod(layer.top_shapes[0]) * (pixels if param.pool == _MAX else pixels + 1)


def _lrn(layer: Layer) -> int:
    param, shape = layer.param.lrn_param, layer.bottom_shapes[0]
    size, channels, pixels = param.local_size, shape[1], math.prod(shape[2:])
    if param.norm_region == _WITHIN_CHANNEL:
        return math.prod(shape) * (2 * size * size + 2)
    half = (size - 1) // 2
    first = shape[0] * pixels * (2 * min(half, channels) + 4 * channels)
    return first + ((size + 2 * (channels - size)) * pixels if half < channels else 0)


def _mvn(layer: Layer) -> int:
    shape: Shape = layer.bottom_shapes[0]
    axes = 2 if layer.param.mvn_param.normalize_variance else 1
    return 6 * math.prod(shape) + 3 * math.prod(shape[:axes])


def _prior_box(layer: Layer) -> int:
    height, width = layer.bottom_shapes[0][2:]
    boxes = math.prod(layer.top_shapes[0]) // (8 * height * width)
    return sum(4 * boxes * math.prod(bottom[2:]) for bottom in layer.bottom_shapes)


_COUNTS: dict[str, Callable[[Layer], int]] = {
    "Convolution": _convolution,
    "ConvolutionDepthwise": _convolution,
    "DepthwiseConvolution": _convolution,
    "Deconvolution": _deconvolution,
    "Eltwise": lambda layer: len(layer.bottom_shapes) * math.prod(layer.bottom_shapes[0]),
    "InnerProduct": _inner_product,
    "LRN": _lrn,
    "MVN": _mvn,
    "Pooling": _pooling,
    "Power": lambda layer: (2 if layer.param.power_param.power == 1 else 10) * math.prod(layer.bottom_shapes[0]),
    "PriorBox": _prior_box,
    "Scale": lambda layer: 2 * sum(map(math.prod, layer.bottom_shapes)),
}
