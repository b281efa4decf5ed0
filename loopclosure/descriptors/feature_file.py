"""Descriptors that another program computed: the features.npz of ``netspec extract --images`` (docs/features.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from loopclosure.errors import InputError
from netspec.files.arrays import read_npz

# Arrays of the file that are not descriptors.
NOT_FEATURES = ("names", "keys", "stamps", "seconds_per_image", "seconds_per_record", "parameters", "zooms")


@dataclass(frozen=True)
class Features:
    """Descriptors of images.

    features           (N, D) float32; with several views of each image (N, views D), view after view
    names              the N images' names, empty if the file has none
    stamps             (N,) seconds, None if the file has none
    seconds_per_image  the net's time per image, NaN if the file does not have it
    views              number of described views per image: the length of the file's ``zooms``
    """

    path: Path
    features: np.ndarray
    names: list[str] = field(default_factory=list)
    stamps: np.ndarray | None = None
    seconds_per_image: float = float("nan")
    views: int = 1

    def rows_of(self, images: Sequence[Path]) -> np.ndarray:
        """Return the descriptors (len(images), D) of these images, found by name.

        Names match if their last parts are equal, with as many parts as needed to distinguish all images: ``rgb/1.png``
        in the file matches ``/data/fr1/rgb/1.png``. A descriptor is that of one image only: with equal names in two
        folders, the names in the file must have the folders too. A file without names must have exactly these images,
        in order.
        """
        if not self.names:
            if len(self.features) != len(images):
                raise InputError(
                    f"has {len(self.features)} descriptors and no names, but there are {len(images)} images", self.path
                )
            return self.features
        missing = ""
        for depth in range(max(len(PurePosixPath(name).parts) for name in self.names), 0, -1):
            rows: dict[str, list[int]] = {}
            for number, name in enumerate(self.names):
                rows.setdefault("/".join(PurePosixPath(name).parts[-depth:]), []).append(number)
            found = [rows.get("/".join(image.parts[-depth:]), []) for image in images]
            absent = [image for image, numbers in zip(images, found, strict=True) if not numbers]
            if absent:
                missing = f"has no descriptor of {absent[0]} ({len(absent)} of {len(images)} images are not in it)"
                continue
            image_of: dict[int, Path] = {}
            for image, numbers in zip(images, found, strict=True):
                if len(numbers) > 1:
                    raise InputError(f"names {image.name} {len(numbers)} times; which one is {image}?", self.path)
                first = image_of.setdefault(numbers[0], image)
                if first.absolute() != image.absolute():
                    name = self.names[numbers[0]]
                    raise InputError(f"has one descriptor of {name}; is it that of {first} or of {image}?", self.path)
            return self.features[[numbers[0] for numbers in found]]
        raise InputError(f"{missing}; its first name is {self.names[0]}", self.path)


def read_features(path: str | Path) -> Features:
    """Read a features.npz. If it has no array ``features``, its only other array, named after a blob, is used."""
    path = Path(path)
    arrays = read_npz(path, "the .npz that netspec extract --images writes")
    candidates = [name for name in arrays if name not in NOT_FEATURES]
    chosen = "features" if "features" in arrays else candidates[0] if len(candidates) == 1 else ""
    if not chosen:
        found = ", ".join(sorted(arrays)) or "nothing"
        raise InputError(f'has no array "features", and not exactly one other; found {found}', path)
    features = arrays[chosen]
    if features.ndim < 2 or features.dtype.kind not in "fiu" or not len(features):
        raise InputError(
            f'"{chosen}" has shape {features.shape}, {features.dtype}; expected (images, dimensions)', path
        )
    features = features.reshape(len(features), -1).astype(np.float32)
    finite = np.all(np.isfinite(features), axis=1)
    if not np.all(finite):
        count, first = np.count_nonzero(~finite), np.argmin(finite)
        raise InputError(
            f"{count} of {len(features)} descriptors have a NaN or an infinity, the first in row {first} (from 0); "
            "did the net diverge?",
            path,
        )
    names = [str(name) for name in arrays.get("names", np.zeros(0, str)).reshape(-1)]
    stamps = arrays.get("stamps")
    if stamps is not None and (stamps.ndim != 1 or stamps.dtype.kind not in "fiu"):
        raise InputError(f'"stamps" has shape {stamps.shape}, {stamps.dtype}; expected one number per image', path)
    for what, values in (("names", names), ("stamps", stamps)):
        if values is not None and len(values) not in (0, len(features)):
            raise InputError(f"has {len(features)} descriptors but {len(values)} {what}", path)
    seconds = _number(arrays, "seconds_per_image", path)
    views = arrays["zooms"].size if "zooms" in arrays else 1
    if not views or features.shape[1] % views:
        raise InputError(f"has {features.shape[1]} numbers per image, which cannot be {views} views", path)
    return Features(path, features, names, stamps, seconds, views)


def _number(arrays: dict[str, np.ndarray], name: str, path: Path) -> float:
    values = arrays.get(name, np.array(np.nan))
    if values.size != 1 or values.dtype.kind not in "fiu":
        raise InputError(f'"{name}" has shape {values.shape}, {values.dtype}; expected a number', path)
    return float(values.item())
