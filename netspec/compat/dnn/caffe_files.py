"""A prototxt and its weights, given as paths or as the contents of files, and the runnable nets made from them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from netspec import log
from netspec.data.blobs import Shape
from netspec.errors import ForkFault, SpecError, Where
from netspec.exact import NONE
from netspec.files.kinds import unreadable
from netspec.graph.filter import filter_net, with_state
from netspec.graph.options import BuildOptions
from netspec.graph.speed import speed
from netspec.proto.binary import parse_binary
from netspec.proto.schema import TEST, NetParameter
from netspec.proto.source_map import SourceMap
from netspec.proto.text import parse_net_text
from netspec.proto.upgrade.current import upgrade_net

if TYPE_CHECKING:
    from netspec.net.net import Net

FileOrBytes = str | os.PathLike[str] | bytes | bytearray | memoryview | np.ndarray

_NOT_SKIPPED = ("ConvolutionParameter", "PoolingParameter")  # another field may change their windows
OPENCV_LAYERS = ("PriorBox", "DetectionOutput")  # netspec/compat/dnn/opencv_layers.py
PROTOTXT, WEIGHTS = "<prototxt>", "<caffeModel>"  # what errors call files that were given as bytes


@dataclass(frozen=True)
class CaffeFiles:
    """A net in phase TEST as in its prototxt, and the source of its weights (None: no weights).

    ``digest`` is the SHA-256 of the prototxt.
    """

    net: NetParameter
    source: SourceMap
    weights: FileOrBytes | None = None
    digest: str = ""

    @property
    def learns(self) -> bool:
        """Whether a layer with weights must get them from a file, because the prototxt has none."""
        learning = ("Convolution", "Deconvolution", "InnerProduct", "ConvolutionDepthwise", "DepthwiseConvolution")
        return any(layer.type in learning and not layer.blobs for layer in self.net.layer)

    @property
    def inputs(self) -> dict[str, Shape | None]:
        """The input blobs and their shapes, None if the prototxt gives none."""
        found: dict[str, Shape | None] = {}
        for layer in self.net.layer:
            if layer.type == "Input":
                shapes = [tuple(shape.dim) or None for shape in layer.input_param.shape]
                shapes = shapes * len(layer.top) if len(shapes) == 1 else shapes
                found.update(zip(layer.top, shapes or [None] * len(layer.top), strict=False))
        return found

    def build(self, shapes: Mapping[str, Shape], device: str = "cpu") -> Net:
        """Return the net for inputs of the given shapes; on "meta" only shapes are computed. Raises SpecError.

        SSD's layers are computed as in OpenCV (netspec/compat/dnn/opencv_layers.py).
        """
        import torch

        from netspec.net.build import build_filtered

        options = BuildOptions(device, seed=0, exact=NONE, speed=speed())
        # A parameter that is made in inference mode can never be written. Warnings are of fields without effect.
        with torch.inference_mode(False), log.silent():
            net = build_filtered(self._reshaped(shapes), self.source, options)
        for i, layer in enumerate(net.layers):
            if layer.type in OPENCV_LAYERS:
                from netspec.compat.dnn.opencv_layers import (
                    LAYERS,  # it registers SSD's layers, for nets that have them
                )

                net.replace_layer(i, LAYERS[layer.type](layer.param, layer.bottom_shapes, layer.context))
        if self.weights is not None and device != "meta":
            self._load(net, self.weights)
        return net

    def _reshaped(self, shapes: Mapping[str, Shape]) -> NetParameter:
        """Return the net with these shapes of its inputs."""
        net = NetParameter()
        net.CopyFrom(self.net)
        wanted = {**self.inputs, **shapes}
        for layer in net.layer:
            if layer.type == "Input" and any(blob in shapes for blob in layer.top):
                del layer.input_param.shape[:]
                for blob in layer.top:
                    layer.input_param.shape.add().dim.extend(wanted[blob] or ())
        return net

    def _load(self, net: Net, weights: FileOrBytes) -> None:
        from netspec.net.weights import copy_weights, load_weights

        if isinstance(weights, str | os.PathLike):
            load_weights(net, os.fspath(weights))
            return
        message = parse_binary(bytes_of(weights), WEIGHTS, NetParameter)
        source = SourceMap.unknown(WEIGHTS, len(message.layer) + len(message.layers))
        copy_weights(net, upgrade_net(message, source)[0], Path(WEIGHTS))


def read_files(prototxt: FileOrBytes, weights: FileOrBytes | None) -> CaffeFiles:
    """Read a prototxt and filter it for phase TEST. Raises SpecError."""
    if isinstance(prototxt, str | os.PathLike):
        file = os.fspath(prototxt)
        try:
            data = Path(file).read_bytes()
        except OSError as fault:
            raise SpecError(unreadable(file, fault), Where(file)) from None
    else:
        file, data = PROTOTXT, bytes_of(prototxt)
    text = data.removeprefix(b"\xef\xbb\xbf").decode(errors="surrogateescape")
    net, source = parse_net_text(text, file, upgrade=False, report=_skip)
    if not net.input_shape and not net.input_dim:
        for _ in net.input:  # Caffe leaves out an input without a shape; for OpenCV it gets one from setInput
            net.input_shape.add()
    with log.silent():  # of older formats
        net, source = upgrade_net(net, source)
    filtered, source = filter_net(with_state(net, TEST), source)
    return CaffeFiles(filtered, source, weights, hashlib.sha256(data).hexdigest())


def _skip(fault: SpecError) -> None:
    """Skip an unknown field with a warning; raise the fault if OpenCV's importer fails, too."""
    if not isinstance(fault, ForkFault) or fault.owner in _NOT_SKIPPED:
        raise fault
    log.logger.warning(f"{fault.where}: skipped: {fault.message}")


def bytes_of(data: Any) -> bytes:
    """Return the bytes of a buffer or of an array."""
    return data.tobytes() if isinstance(data, np.ndarray) else bytes(data)
