"""Datum <-> ndarray: one record of Caffe's databases.

Images are planar, (channels, height, width), and blue, green, red in that order, as OpenCV decodes them.

Caffe: src/caffe/util/io.cpp (CVMatToDatum, DecodeDatumToCVMat), src/caffe/data_transformer.cpp
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from netspec.files.kinds import is_cut_png, pointer_fault
from netspec.files.opencv import cv2
from netspec.proto.schema import Datum


def array_to_datum(array: np.ndarray, label: int | None = None) -> Datum:
    """Return a Datum of an array (C, H, W): uint8 in ``data``, any other type as floats in ``float_data``.

    Raises ValueError if the array does not have three axes.
    """
    if array.ndim != 3:
        raise ValueError(f"a Datum contains channels x height x width, found an array of shape {array.shape}")
    channels, height, width = array.shape
    datum = Datum(channels=channels, height=height, width=width)
    if array.dtype == np.uint8:
        datum.data = array.tobytes()
        datum.encoded = False  # CVMatToDatum writes the default value too
    else:
        datum.float_data.extend(np.asarray(array, np.float32).ravel().tolist())
    if label is not None:
        datum.label = int(label)
    return datum


def encoded_datum(image: bytes, label: int | None = None, shape: tuple[int, int, int] | None = None) -> Datum:
    """Return a Datum of the bytes of an image file (PNG, JPEG, ...).

    As in Caffe, ``shape`` (C, H, W) is written for an image encoded by the program, and omitted for a file stored
    unchanged (EncodeCVMatToDatum, ReadFileToDatum).
    """
    datum = Datum(data=image, encoded=True)
    if shape is not None:
        datum.channels, datum.height, datum.width = shape
    if label is not None:
        datum.label = int(label)
    return datum


def parse_datum(record: bytes) -> Datum:
    """Return the Datum of a record; raises ValueError if the record is not a Datum."""
    try:
        return Datum.FromString(record)
    except DecodeError:
        raise ValueError(f"is not a Datum ({len(record)} bytes)") from None


def datum_to_array(datum: Any, color: bool | None = None, warn: Callable[[str], None] | None = None) -> np.ndarray:
    """Return the values (C, H, W): uint8 from ``data``, float32 from ``float_data``; ``data`` if both are given.

    An encoded image is decoded to three channels if ``color`` is true, to one if it is false, and to the file's
    channels if it is None. Raw data is not converted. The array may be read-only. Raises ValueError for a Datum that is
    inconsistent or cannot be decoded.

    If raw data is longer than its shape, Caffe's data layers read the first values (data_transformer.cpp), and its
    other tools refuse it. With ``warn``, the first values are read, and ``warn`` is called with a message.
    """
    if datum.encoded:
        return decode_image(datum.data, color)
    shape = (datum.channels, datum.height, datum.width)
    data = datum.data
    values = np.frombuffer(data, np.uint8) if data else np.array(datum.float_data, np.float32)
    count = math.prod(shape)
    if len(values) != count or not count:
        field = "data" if data else "float_data"
        fault = f"contains {len(values)} values in {field}, but channels x height x width is {shape_text(shape)}"
        if warn is None or not 0 < count < len(values) or min(shape) < 0:
            raise ValueError(fault)
        warn(fault)
    return values[:count].reshape(shape)


def decode_image(image: bytes, color: bool | None = None) -> np.ndarray:
    """Decode an image file's bytes to uint8 (C, H, W); ``color`` as in :func:`datum_to_array`."""
    return planar(decode_pixels(image, color))


def decode_pixels(image: bytes, color: bool | None = None) -> np.ndarray:
    """Decode an image file's bytes in OpenCV's layout, uint8 (H, W) or (H, W, C); see :func:`decode_image`."""
    flag = cv2.IMREAD_UNCHANGED if color is None else cv2.IMREAD_COLOR if color else cv2.IMREAD_GRAYSCALE
    try:
        pixels = cv2.imdecode(np.frombuffer(image, np.uint8), flag) if image and not is_cut_png(image) else None
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError(pointer_fault(image) or "cannot be decoded as an image")
    if pixels.dtype != np.uint8:
        raise ValueError(f"is an image of {pixels.dtype} values; only 8 bits per channel can be read")
    return pixels


def planar(pixels: np.ndarray) -> np.ndarray:
    """Convert OpenCV's (H, W) or (H, W, C) to contiguous (C, H, W)."""
    return np.ascontiguousarray(pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1))


def shape_text(shape: tuple[int, ...]) -> str:
    """Return a shape as ``3 x 48 x 64``."""
    return " x ".join(map(str, shape))
