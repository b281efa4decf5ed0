"""Caffe's layers; importing this package registers them all."""

from netspec.layers import (  # noqa: F401
    activation,
    common,
    data,
    data_memory,
    loss,
    normalization,
    python,
    recurrent,
    utility,
    utility_shape,
    vision_convolution,
    vision_pooling,
)
from netspec.layers.base import Context, Layer, Random
from netspec.layers.registry import layer_class, layer_types, register

__all__ = ["Context", "Layer", "Random", "layer_class", "layer_types", "register"]
