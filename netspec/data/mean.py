"""Mean images, as data layers read them.

Caffe: src/caffe/data_transformer.cpp
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from netspec import log
from netspec.data import blobs
from netspec.errors import SpecError, Where
from netspec.files.arrays import opened, read_array
from netspec.files.kinds import pointer_fault, unreadable
from netspec.files.limits import read_bytes
from netspec.proto.schema import BlobProto


def read_mean(path: str, where: Where | None = None) -> np.ndarray:
    """Return the mean image of a .binaryproto file: float32 (C, H, W).

    ``where`` is the position in the prototxt. Raises SpecError if the file cannot be read or is not an image.
    """
    log.info("data_transformer.cpp:25", f"Loading mean file from: {path}")
    try:
        data = read_bytes(path)
    except OSError as fault:
        raise SpecError(f'mean file "{path}" {unreadable(path, fault)}', where) from None
    if fault := pointer_fault(data):
        raise SpecError(f'mean file "{path}" {fault}', where)
    try:
        mean = blobs.to_array(BlobProto.FromString(data))
    except (DecodeError, ValueError) as fault:
        raise SpecError(f'mean file "{path}" is not a BlobProto with a mean image ({fault})', where) from None
    if mean.ndim != 3 and not (mean.ndim == 4 and mean.shape[0] == 1):
        raise SpecError(f'mean file "{path}" contains a blob of shape {mean.shape}, expected one image', where)
    if not np.all(np.isfinite(mean)):
        raise SpecError(f'mean file "{path}" contains a NaN or an infinity', where)
    return mean.reshape(mean.shape[-3:]).astype(np.float32)


def fitted(mean: np.ndarray, shape: Sequence[int | None], name: str, where: Where) -> np.ndarray:
    """Return a mean that broadcasts against images of ``shape`` (C, H, W); ``name`` is the mean's in an error.

    It is one number, one for each channel, or an image (C, H, W), whose center is taken, as Caffe crops images in phase
    TEST. Raises SpecError for a mean that does not fit, as an image does not if the height or width is dynamic (None).
    """
    channels, height, width = shape
    if mean.ndim < 2:
        if mean.size not in (1, channels):
            raise SpecError(f"{name} has {mean.size} values, expected 1 or {channels}, one for each channel", where)
        return mean.reshape(-1, 1, 1)
    mean = mean[0] if mean.ndim == 4 and len(mean) == 1 else mean
    if height is None or width is None:
        raise SpecError(f"{name} is an image, but the height and width are dynamic; give one for each channel", where)
    if mean.ndim != 3 or mean.shape[0] != channels or mean.shape[1] < height or mean.shape[2] < width:
        raise SpecError(f"{name} has shape {mean.shape}, expected at least {tuple(shape)} for these images", where)
    top, left = (mean.shape[1] - height) // 2, (mean.shape[2] - width) // 2
    return mean[:, top : top + height, left : left + width]


def read_mean_option(text: str) -> np.ndarray:
    """Return the mean given by ``--mean``: numbers separated by commas, or a .binaryproto or .npy file (C, H, W)."""
    try:
        return np.array([float(part) for part in text.split(",")], np.float32)
    except ValueError:
        pass
    if not text.endswith(".npy"):
        return read_mean(text, Where("--mean"))
    with opened(Path(text), "an array of a mean") as stream:
        mean = read_array(stream)
        if not np.all(np.isfinite(mean)):
            raise ValueError("it contains a NaN or an infinity")
        return np.array(mean, np.float32)
