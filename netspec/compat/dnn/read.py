"""Reads nets: Caffe's files here, all others with cv2.dnn; and writes weights in half precision."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import PurePath
from typing import Any

from netspec.compat.dnn.caffe_files import FileOrBytes, read_files
from netspec.compat.dnn.errors import as_dnn_error
from netspec.compat.dnn.net import Net
from netspec.data.blobs import in_half_precision, to_array
from netspec.errors import SpecError, Where
from netspec.files.opencv import dnn as opencv
from netspec.files.whole_file import write_whole
from netspec.proto.binary import parse_net_binary

_CAFFE = (".prototxt", ".caffemodel", ".caffemodel.h5")


def readNetFromCaffe(prototxt: FileOrBytes, caffeModel: FileOrBytes | None = None) -> Net:
    """Return the net of a prototxt with the weights of a .caffemodel (or .caffemodel.h5).

    Each is a path or the content of the file: bytes, a bytearray or an array of bytes. The prototxt may use
    dialects. Raises DnnError.
    """
    if isinstance(caffeModel, str) and not caffeModel:
        caffeModel = None
    with as_dnn_error("readNetFromCaffe"):
        return Net(read_files(prototxt, caffeModel))


def readNet(model: Any, config: Any = "", framework: Any = "", **others: Any) -> Any:
    """Return the net of two files in either order, recognized by name; cv2.dnn.readNet reads other formats.

    ``readNet("caffe", weights, prototxt)`` takes the contents of the files. Raises DnnError, or an error of cv2.dnn.
    """
    if not isinstance(config, str | os.PathLike):  # readNet(framework, bufferModel, bufferConfig)
        if str(model).lower() == "caffe":
            return readNetFromCaffe(framework, config)
        return opencv.readNet(model, config, framework, **others)
    names = [PurePath(name).name.lower() for name in (model, config)]
    if str(framework).lower() != "caffe" and not any(name.endswith(_CAFFE) for name in names):
        return opencv.readNet(os.fspath(model), os.fspath(config), framework, **others)
    swapped = names[0].endswith(_CAFFE[0]) or names[1].endswith(_CAFFE[1:])
    prototxt, weights = (model, config) if swapped else (config, model)
    return readNetFromCaffe(prototxt, os.fspath(weights))


def shrinkCaffeModel(
    src: str | os.PathLike[str],
    dst: str | os.PathLike[str],
    layersTypes: Sequence[str] = ("Convolution", "InnerProduct"),
) -> None:
    """Write a .caffemodel to ``dst`` with the blobs of these types of layers in half precision. Raises DnnError."""
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
