"""Caffe's layers; importing this package registers them all."""

from netspec.layers import activation, common, contrast, normalization, powers, recurrent, scale  # noqa: F401
from netspec.layers.contract.base import Layer
from netspec.layers.contract.context import Context, Random
from netspec.layers.contract.registry import class_of, layer_class, layer_types, register, unknown_type
from netspec.layers.data import files, hdf5, memory  # noqa: F401
from netspec.layers.loss import losses, scores  # noqa: F401
from netspec.layers.utility import arithmetic, parts, python, shape  # noqa: F401
from netspec.layers.vision import convolution, pooling, sliding  # noqa: F401

__all__ = ["Context", "Layer", "Random", "class_of", "layer_class", "layer_types", "register", "unknown_type"]
