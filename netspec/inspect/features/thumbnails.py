"""The images that descriptors were computed of, small, by name or key."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from netspec.data.records import open_records
from netspec.errors import SpecError, Where
from netspec.files.image_list import list_images
from netspec.files.opencv import cv2
from netspec.inspect.features.images import read_pixels

SIDE = 112  # pixels on the longer side


@dataclass(frozen=True)
class Thumbnails:
    """Images, uint8 BGR or gray, by the number of their descriptor; the labels of all, where the source has some."""

    images: dict[int, np.ndarray]
    labels: list[float | None] | None = None


def thumbnails(source: str | Path, names: list[str] | None, count: int) -> Thumbnails:
    """Return the images of ``count`` descriptors with these names or keys; without names, those in the source's order.

    ``source`` is a folder or a list of images, or a database; of a record that holds two images the first is shown.
    Raises SpecError where an image is missing.
    """
    path = Path(source)
    if path.is_dir() and ((path / "data.mdb").is_file() or (path / "CURRENT").is_file()):
        return _of_records(path, names, count)
    listed = list_images(path)
    numbers = _numbers(names, {name: k for k, name in enumerate(listed.names)}, len(listed.names), count, path)
    return Thumbnails({k: _small(read_pixels(listed.paths[number], 3)) for k, number in enumerate(numbers)})


def _of_records(path: Path, names: list[str] | None, count: int) -> Thumbnails:
    records = open_records(path)
    keys = {} if names is None else {records[k].key: k for k in range(len(records))}
    numbers = _numbers(names, keys, len(records), count, path)
    images, labels = {}, []
    for k, number in enumerate(numbers):
        record = records[number]
        labels.append(record.label)
        if record.values is not None and len(record.values) in (1, 2, 3, 6) and record.values.dtype == np.uint8:
            channels = 3 if len(record.values) % 3 == 0 else 1
            images[k] = _small(record.values[:channels].transpose(1, 2, 0).squeeze())
    return Thumbnails(images, labels)


def _numbers(names: list[str] | None, known: dict[str, int], size: int, count: int, path: Path) -> list[int]:
    """Return which image each descriptor belongs to."""
    if names is None:
        if size != count:
            raise SpecError(f"has {size} images; the descriptors are {count}, without names", Where(str(path)))
        return list(range(count))
    for name in names:
        if name not in known:
            raise SpecError(f'has no image "{name}", of which there is a descriptor', Where(str(path)))
    return [known[name] for name in names]


def _small(image: np.ndarray) -> np.ndarray:
    scale = SIDE / max(image.shape[:2])
    if scale >= 1:
        return np.ascontiguousarray(image)
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
