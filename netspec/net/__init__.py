"""Runnable nets: building, weights, forward pass."""

from netspec.graph.options import BuildOptions
from netspec.net.build import build_net, load_net
from netspec.net.net import Net
from netspec.net.weights import load_weights, save_weights

__all__ = ["BuildOptions", "Net", "build_net", "load_net", "load_weights", "save_weights"]
