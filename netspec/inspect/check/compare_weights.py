"""Compares two weights files: which layers differ, and by how much."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from netspec.errors import SpecError, Where
from netspec.inspect.check.difference import Difference, Differences
from netspec.inspect.stored_weights import stored_layers

Weights = dict[str, tuple[np.ndarray, ...]]


def compare_weights(first: str | Path, second: str | Path, tolerance: float = 0.0) -> Differences:
    """Yield the blobs that differ by more than ``tolerance``, and the blobs that only one file has.

    Layers are matched by name. Shapes that differ only in leading axes of size 1 are equal. Raises SpecError for
    a file that is neither a .caffemodel nor a .caffemodel.h5.
    """
    old, new = read_weights(first), read_weights(second)
    here, there = Where(str(second)), Where(str(first))
    for name in old:
        if name not in new:
            yield Difference(there, f'layer "{name}" is only here, not in the second file')
    for name, arrays in new.items():
        if name not in old:
            yield Difference(here, f'layer "{name}" is only here, not in the first file')
            continue
        if len(arrays) != len(old[name]):
            yield Difference(here, f'layer "{name}" has {len(arrays)} blobs, had {len(old[name])}')
        for k, (was, now) in enumerate(zip(old[name], arrays, strict=False)):
            if said := _difference(was, now, tolerance):
                yield Difference(here, f'layer "{name}", blob {k}: {said}')


def read_weights(path: str | Path) -> Weights:
    """Return the blobs of each layer that has any, in the file's order."""
    if not Path(path).is_file():
        raise SpecError("is not a file", Where(str(path)))
    read = {layer.name: layer.blobs for layer in stored_layers(path)}
    if not read:
        raise SpecError("holds no weights", Where(str(path)))
    return read


def _difference(was: np.ndarray, now: np.ndarray, tolerance: float) -> str:
    if _bare(was) != _bare(now):
        return f"shape is {_times(now)}, was {_times(was)}"
    a, b = was.reshape(-1).astype(np.float64), now.reshape(-1).astype(np.float64)
    with np.errstate(invalid="ignore"):
        difference = np.abs(a - b)
        difference = np.where(
            (a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.where(np.isnan(difference), np.inf, difference)
        )
    count = int((difference > tolerance).sum())
    if not count:
        return ""
    largest = np.abs(a[np.isfinite(a)]).max(initial=0.0)
    changed = difference[difference > tolerance]
    return (
        f"{count} of {a.size} values differ, by {changed.mean():.3g} on average and {changed.max():.3g} at most; "
        f"the largest was {largest:.3g}"
    )


def _bare(array: np.ndarray) -> tuple[int, ...]:
    shape = array.shape
    while shape and shape[0] == 1:
        shape = shape[1:]
    return shape


def _times(array: np.ndarray) -> str:
    return "x".join(map(str, array.shape)) or "scalar"
