"""Where the pixels of a layer's top are in its bottom.

Caffe: python/caffe/coord_map.py
"""

from __future__ import annotations

from typing import Any

#: Layers whose pixels are those of their bottoms
PASS_THROUGH_LAYERS = (
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


def of_windows(stride: Any, extent: Any, pad: Any) -> tuple[Any, Any]:
    """Return (scale, shift) of a convolution or pooling: pixel i of the bottom is at scale i + shift in the top.

    ``extent`` is the size of the kernel with its holes. Numbers or arrays of one number for each axis.
    """
    return 1 / stride, (pad - (extent - 1) / 2) / stride


def inverted(scale: Any, shift: Any) -> tuple[Any, Any]:
    """Return (scale, shift) of the inverse, as for a deconvolution."""
    return 1 / scale, -shift / scale
