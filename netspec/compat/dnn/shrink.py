"""Weights in half precision, as cv2.dnn.shrinkCaffeModel writes them."""

from __future__ import annotations

import os
from collections.abc import Sequence

from netspec.compat.dnn.errors import as_dnn_error
from netspec.data.blobs import in_half_precision, to_array
from netspec.errors import SpecError, Where
from netspec.files.whole_file import write_whole
from netspec.proto.binary import parse_net_binary


def shrinkCaffeModel(
    src: str | os.PathLike[str],
    dst: str | os.PathLike[str],
    layersTypes: Sequence[str] = ("Convolution", "InnerProduct"),
) -> None:
    """Write a .caffemodel to ``dst`` with the blobs of layers of these types in half precision. Raises DnnError."""
    with as_dnn_error("shrinkCaffeModel"):
        net, _ = parse_net_binary(os.fspath(src))
        for layer in net.layer:
            for i, blob in enumerate(layer.blobs if layer.type in layersTypes else ()):
                try:
                    small = in_half_precision(to_array(blob))
                except ValueError as fault:
                    message = f'blob {i} of layer "{layer.name}": {fault}'
                    raise SpecError(message, Where(os.fspath(src))) from None
                blob.CopyFrom(small)
        write_whole(os.fspath(dst), net.SerializeToString())
