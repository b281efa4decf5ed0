"""Descriptors in two dimensions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netspec.errors import SpecError, Where, did_you_mean
from netspec.files.arrays import read_npz

PCA, TSNE = "pca", "tsne"
_BESIDE = ("stamps", "seconds_per_image", "seconds_per_record", "parameters", "zooms", "names", "keys")
_PERPLEXITY = 30.0  # of t-SNE: about how many neighbors a point has


@dataclass(frozen=True)
class Features:
    """Descriptors ``values`` (N, D), the array's name in the file, and the names or keys of the images, if known."""

    values: np.ndarray
    array: str
    names: list[str] | None


def read_features(path: str | Path, array: str = "") -> Features:
    """Return the descriptors of a features.npz (docs/features.md); ``array`` names one of several. Raises SpecError."""
    where = Where(str(path))
    arrays = read_npz(path, "a features.npz of netspec extract")
    found = {name: values for name, values in arrays.items() if name not in _BESIDE and values.ndim == 2}
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
    """Return descriptors (N, D) as points (N, 2), and a sentence that says what the plane is.

    The signs of principal components are chosen so that the entry of greatest size is positive; t-SNE starts from them.
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
    return np.asarray(moved), f"t-SNE, perplexity {perplexity:g}: only who is near whom has a meaning"
