"""The mean image of a database, computed and written as Caffe's .binaryproto.

Caffe: tools/compute_image_mean.cpp
"""

from __future__ import annotations

import numpy as np

from netspec import log
from netspec.data.database import Reader
from netspec.data.datum import datum_to_array, parse_datum, shape_text
from netspec.errors import SpecError, Where
from netspec.files.whole_file import write_whole
from netspec.proto.schema import BlobProto


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
            message = (
                f'record "{name}" is {shape_text(image.shape)}, but the first, "{first}", is {shape_text(total.shape)}'
            )
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
