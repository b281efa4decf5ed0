"""Reading nets: Caffe's files here, all others by cv2.dnn."""

from __future__ import annotations

import os
from pathlib import PurePath
from typing import Any

from netspec.compat.dnn.caffe_files import FileOrBytes, read_files
from netspec.compat.dnn.errors import as_dnn_error
from netspec.compat.dnn.net import Net
from netspec.files.opencv import dnn as opencv

_CAFFE = (".prototxt", ".caffemodel", ".caffemodel.h5")


def readNetFromCaffe(prototxt: FileOrBytes, caffeModel: FileOrBytes | None = None) -> Net:
    """Return the net of a prototxt with the weights of a .caffemodel (or .caffemodel.h5).

    Either is a path, or what is in the file: bytes, a bytearray or an array of bytes. The dialects that the prototxt
    needs are switched on. Raises DnnError.
    """
    if isinstance(caffeModel, str) and not caffeModel:
        caffeModel = None
    with as_dnn_error("readNetFromCaffe"):
        return Net(read_files(prototxt, caffeModel))


def readNet(model: Any, config: Any = "", framework: Any = "", **others: Any) -> Any:
    """Return the net of two files in either order, by their names; what is not Caffe's is left to cv2.dnn.readNet.

    ``readNet("caffe", weights, prototxt)`` takes what is in the files. Raises DnnError, and what cv2.dnn raises.
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
