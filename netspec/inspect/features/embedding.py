"""Projects descriptors to two dimensions, and reads thumbnails of their images by name or key."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netspec.errors import SpecError, Where, did_you_mean
from netspec.files.arrays import read_npz
from netspec.files.image_list import list_images
from netspec.files.opencv import cv2
from netspec.inspect.features.images import read_pixels
from netspec.inspect.records import open_records

PCA, TSNE = "pca", "tsne"
_NOT_DESCRIPTORS = ("stamps", "seconds_per_image", "seconds_per_record", "parameters", "zooms", "names", "keys")
_PERPLEXITY = 30.0  # perplexity of t-SNE: the approximate number of neighbors of a point


@dataclass(frozen=True)
class Features:
    """Descriptors ``values`` (N, D), the array's name in the file, and the names or keys of the images, if known."""

    values: np.ndarray
    array: str
    names: list[str] | None


def read_features(path: str | Path, array: str = "") -> Features:
    """Return the descriptors of a features.npz (docs/features.md); ``array`` names one of several. Raises SpecError."""
    where = Where(str(path))
    arrays = read_npz(path, "a features.npz written by netspec extract")
    found = {name: values for name, values in arrays.items() if name not in _NOT_DESCRIPTORS and values.ndim == 2}
    chosen = array or next(iter(found), "")
    if chosen not in found:
        hint = did_you_mean(array, list(found)) or ";"
        raise SpecError(f'has no descriptors "{array}"{hint} it has: {", ".join(found) or "none"}', where)
    values = found[chosen].astype(np.float64)
    if len(values) < 2 or not np.isfinite(values).all():
        raise SpecError(f"{chosen} has {len(values)} rows; expected two or more, of finite numbers", where)
    names = arrays.get("names", arrays.get("keys"))
    return Features(values, chosen, None if names is None or len(names) != len(values) else names.tolist())


def in_plane(values: np.ndarray, method: str = PCA) -> tuple[np.ndarray, str]:
    """Reduce descriptors (N, D) to points (N, 2); also return a description of the method.

    Each principal component has the sign that makes its largest entry positive. t-SNE starts from the components.
    """
    centered = values - values.mean(axis=0)
    left, sizes, right = np.linalg.svd(centered, full_matrices=False)
    signs = np.sign(right[np.arange(len(right)), np.abs(right).argmax(axis=1)])
    count = min(2, len(sizes))
    points = np.zeros((len(values), 2))
    points[:, :count] = left[:, :count] * sizes[:count] * signs[:count]
    shares = np.square(sizes) / max(float(np.square(sizes).sum()), 1e-300)
    if method == PCA:
        return points, f"two principal components, {100 * shares[:2].sum():.0f} % of the variance"
    from sklearn.manifold import TSNE as TSne

    perplexity = min(_PERPLEXITY, (len(values) - 1) / 3)
    start: Any = points / max(float(points[:, 0].std()), 1e-12) * 1e-4
    moved = TSne(init=start, perplexity=perplexity, random_state=0, learning_rate="auto").fit_transform(values)
    return np.asarray(moved), f"t-SNE, perplexity {perplexity:g}: only neighborhoods are meaningful"


SIDE = 112  # pixels on the longer side


@dataclass(frozen=True)
class Thumbnails:
    """Images, uint8 BGR or gray, by the index of their descriptor; and all labels, if the source has them."""

    images: dict[int, np.ndarray]
    labels: list[float | None] | None = None


def thumbnails(source: str | Path, names: list[str] | None, count: int) -> Thumbnails:
    """Return the images of ``count`` descriptors by names or keys; without names, in the order of the source.

    ``source`` is a folder, a list of images or a database; for a record with two images, the first is used.
    Raises SpecError if an image is missing.
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
    """Return the index of each descriptor's image."""
    if names is None:
        if size != count:
            raise SpecError(f"has {size} images, but there are {count} descriptors (without names)", Where(str(path)))
        return list(range(count))
    for name in names:
        if name not in known:
            raise SpecError(f'has no image "{name}", which has a descriptor', Where(str(path)))
    return [known[name] for name in names]


def _small(image: np.ndarray) -> np.ndarray:
    scale = SIDE / max(image.shape[:2])
    if scale >= 1:
        return np.ascontiguousarray(image)
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
