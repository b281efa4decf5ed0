"""The interface of cv2.dnn for Caffe's files, which OpenCV 5 no longer reads; all other names come from cv2.dnn.

    from netspec import dnn  # in place of cv2.dnn

    net = dnn.readNetFromCaffe("deploy.prototxt", "x.caffemodel")
    net.setInput(dnn.blobFromImage(image, 1.0, (300, 300), (104, 117, 123)))
    detections = net.forward()

Results, shapes, names and numbers are those of OpenCV 4. Differences: docs/coming-from-opencv.md
"""

from __future__ import annotations

from typing import Any

from netspec.compat.dnn.errors import DnnError
from netspec.compat.dnn.models import ClassificationModel, DetectionModel, Model, SegmentationModel
from netspec.compat.dnn.net import Layer, Net
from netspec.compat.dnn.read import readNet, readNetFromCaffe, shrinkCaffeModel
from netspec.files.opencv import cv2
from netspec.files.opencv import dnn as _opencv  # held here, so that a program may say ``cv2.dnn = dnn``

__all__ = [
    "ClassificationModel",
    "DetectionModel",
    "DnnError",
    "Layer",
    "Model",
    "Net",
    "SegmentationModel",
    "readNet",
    "readNetFromCaffe",
    "shrinkCaffeModel",
]

#: OpenCV 4's constants, numbered from 0 in each list. OpenCV 5 lacks some of them.
_CONSTANTS = {
    "DNN_BACKEND": "DEFAULT HALIDE INFERENCE_ENGINE OPENCV VKCOM CUDA WEBNN TIMVX CANN",
    "DNN_TARGET": "CPU OPENCL OPENCL_FP16 MYRIAD VULKAN FPGA CUDA CUDA_FP16 HDDL NPU CPU_FP16",
}
for _kind, _names in _CONSTANTS.items():
    globals().update({f"{_kind}_{name}": number for number, name in enumerate(_names.split())})


def __getattr__(name: str) -> Any:
    module = cv2 if name.startswith("DNN_LAYOUT_") else _opencv  # OpenCV 5 moved these
    try:
        return getattr(module, name)
    except AttributeError:
        message = f"module 'netspec.dnn' has no attribute {name!r}, nor has cv2.dnn of OpenCV {cv2.__version__}"
        raise AttributeError(message) from None


def __dir__() -> list[str]:
    return sorted({*globals(), *dir(_opencv)})
