"""Caffe's layers; importing this package registers them all."""

from netspec.layers import activation, common, normalization, recurrent, scale  # noqa: F401
from netspec.layers.base import Context, Layer, Random
from netspec.layers.data import files, memory  # noqa: F401
from netspec.layers.loss import losses  # noqa: F401
from netspec.layers.registry import class_of, layer_class, layer_types, register, unknown_type
from netspec.layers.utility import arithmetic, python, shape  # noqa: F401
from netspec.layers.vision import convolution, pooling  # noqa: F401

__all__ = ["Context", "Layer", "Random", "class_of", "layer_class", "layer_types", "register", "unknown_type"]
