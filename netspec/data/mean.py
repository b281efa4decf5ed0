"""Reading, computing and writing mean images in Caffe's .binaryproto format.

Caffe: src/caffe/data_transformer.cpp, tools/compute_image_mean.cpp
"""

from __future__ import annotations

from tokenize import TokenError

import numpy as np
from google.protobuf.message import DecodeError

from netspec import log
from netspec.data import blobs
from netspec.data.database import Reader
from netspec.data.datum import datum_to_array, parse_datum, times
from netspec.errors import SpecError, Where
from netspec.files.kinds import pointer_fault, unreadable
from netspec.files.limits import read_bytes
from netspec.files.whole_file import write_whole
from netspec.proto.schema import BlobProto


def read_mean(path: str, where: Where | None = None) -> np.ndarray:
    """Return the mean image of a .binaryproto file: float32 (C, H, W).

    ``where`` is the place in the prototxt. Raises SpecError if the file cannot be read or is not an image.
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


def read_mean_option(text: str) -> np.ndarray:
    """Return the mean given by ``--mean``: numbers separated by commas, or a .binaryproto or .npy file (C, H, W)."""
    try:
        return np.array([float(part) for part in text.split(",")], np.float32)
    except ValueError:
        pass
    if not text.endswith(".npy"):
        return read_mean(text, Where("--mean"))
    try:
        mapped = np.load(text, mmap_mode="r", allow_pickle=False)  # the file size limits the size of the array
        if not np.all(np.isfinite(mapped)):
            raise ValueError("it contains a NaN or an infinity")
        return np.array(mapped, np.float32)
    except (OSError, ValueError, TypeError, EOFError, SyntaxError, OverflowError, TokenError) as fault:
        raise SpecError(f"cannot be read as an array: {' '.join(str(fault).split())}", Where(text)) from None


def center(mean: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the center of a larger mean image (C, H, W), cropped as Caffe crops images in phase TEST."""
    top, left = (mean.shape[1] - height) // 2, (mean.shape[2] - width) // 2
    return mean[:, top : top + height, left : left + width]


def compute_mean(reader: Reader, where: Where) -> np.ndarray:
    """Return the mean of all records of a database, encoded or not: float32 (C, H, W).

    Sums are exact, while Caffe's float sums begin to round at about 65,000 images. Raises SpecError for a record that
    is not an image, or has a different size than the first.
    """
    first, total = "", np.zeros(0)
    for i in range(len(reader)):
        name = reader.key(i).decode(errors="backslashreplace")
        try:
            datum = parse_datum(reader.record(i))
            image = datum_to_array(datum)
        except ValueError as fault:
            raise SpecError(f'record "{name}" {fault}', where) from None
        if i == 0:
            if datum.encoded:
                log.info("compute_image_mean.cpp:57", "Decoding Datum")
            log.info("compute_image_mean.cpp:70", "Starting iteration")
            first, total = name, np.zeros(image.shape)
        if image.shape != total.shape:
            message = f'record "{name}" is {times(image.shape)}, but the first, "{first}", is {times(total.shape)}'
            raise SpecError(f"{message}; all images must have the same size", where)
        total += image
        if (i + 1) % 10000 == 0:
            log.info("compute_image_mean.cpp:95", f"Processed {i + 1} files.")
    if len(reader) % 10000:
        log.info("compute_image_mean.cpp:101", f"Processed {len(reader)} files.")
    return (total / len(reader)).astype(np.float32)


def write_mean(path: str, mean: np.ndarray) -> None:
    """Write a mean image (C, H, W) with the old fields num, channels, height, width, as compute_image_mean does."""
    log.info("compute_image_mean.cpp:108", f"Write to {path}")
    channels, height, width = mean.shape
    proto = BlobProto(num=1, channels=channels, height=height, width=width, data=mean.ravel().tolist())
    write_whole(path, proto.SerializeToString())


def channel_means(mean: np.ndarray) -> list[float]:
    """Return the mean of each channel, summed one by one in float32 like compute_image_mean."""
    log.info("compute_image_mean.cpp:114", f"Number of channels: {len(mean)}")
    means = [float(np.cumsum(channel, dtype=np.float32)[-1] / np.float32(channel.size)) for channel in mean]
    for c, value in enumerate(means):
        log.info("compute_image_mean.cpp:119", f"mean_value channel [{c}]: {log.number(value)}")
    return means
