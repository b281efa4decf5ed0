"""Caffe's layers; importing this package registers them all."""

from netspec.layers import activation, common, data, loss, normalization, recurrent, utility, vision  # noqa: F401
from netspec.layers.base import Context, Layer, Random
from netspec.layers.registry import layer_class, layer_types, register

__all__ = ["Context", "Layer", "Random", "layer_class", "layer_types", "register"]
