"""Layers of dialects with inputs, and the expected results of plain loops: netspec/dialects/cases/numbers.txt.

Results of the forks themselves are in test_forks_golden.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from case_files import read_table, sizes
from netspec.proto.schema import TEST, TRAIN

REGIONS = [  # image, x1, y1, x2, y2 in pixels of the image; the map is half as large
    [0, 0, 0, 11, 9],
    [1, 2, 1, 6, 5],
    [0, 3, 3, 3, 3],
    [1, 8, 4, 30, 30],  # beyond the map
    [0, 40, 40, 50, 50],  # outside
    [0, -9, -7, 4, 1],
    [1, 0.9, 1, 4.9, 3.1],
    [1, 6, 6, 2, 2],  # turned inside out
]
TRUTH = [  # image, label, instance, xmin, ymin, xmax, ymax, difficult
    [0, 1, 0, 0.10, 0.10, 0.40, 0.45, 0],
    [0, 3, 1, 0.50, 0.40, 0.90, 0.95, 0],
    [0, 3, 2, 0.20, 0.15, 0.45, 0.50, 1],
    [2, 2, 0, 0.30, 0.05, 0.80, 0.60, 0],
    [-1, 0, 0, 0.00, 0.00, 0.00, 0.00, 0],
]
IN_CELLS = [  # of two images: class, x, y, width, height
    [[1, 0.4, 0.45, 0.5, 0.6], [0, 0.9, 0.1, 0.2, 0.3], [0, 0.41, 0.46, 0.5, 0.6], [0] * 5],
    [[1, 0.7, 0.72, 0.6, 0.5], [0] * 5, [0] * 5, [0] * 5],
]


def priors(count: int, largest: float) -> np.ndarray:
    """Boxes, some of them partly outside, and variances: (1, 2, 4 count)."""
    rng = np.random.default_rng(3)
    center, half = rng.uniform(0.1, 0.9, (count, 2)), rng.uniform(0.05, largest, (count, 2))
    boxes = np.concatenate([center - half, center + half], axis=1)
    return np.stack([boxes.reshape(-1), np.tile([0.1, 0.15, 0.2, 0.25], count)])[None]


GIVEN = {
    "regions": np.array(REGIONS),
    "forward": np.array(REGIONS[:-1]),
    "columns": np.array(REGIONS)[:, :, None, None],
    "truth": np.array(TRUTH)[None, None],
    "cells": np.array(IN_CELLS)[:, None],
    "priors16": priors(16, 0.3),
    "priors20": priors(20, 0.2),
    "texts": np.array([[1, 2, 0], [2, 2, 0]]),
    "others": np.array([[0, 1, 2], [1, 1, 2]]),
    "edges": np.array([[0.25, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0], [1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1]]),
}


@dataclass(frozen=True)
class Case:
    """A layer of a dialect, its bottoms, and what is expected of one pass forward and backward.

    The ``fixed`` bottoms follow the others and get no gradient. ``is_derivative`` is False where the gradient is
    Caffe's, and not the derivative of what the layer computes.
    """

    dialect: str
    layer: str
    bottoms: Sequence[str]
    fixed: Sequence[str]
    expected: Sequence[float]
    phase: int
    tops: int
    is_derivative: bool

    @property
    def type_name(self) -> str:
        return self.layer.split("'")[1]

    def arrays(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Return the values of the bottoms and the fixed bottoms."""
        return [_bottom(text, rng) for text in (*self.bottoms, *self.fixed)]


def _bottom(text: str, rng: np.random.Generator) -> np.ndarray:
    """Return an array of GIVEN, or one that is drawn: ``normal:2x3``, ``integers<3:4``.

    ``positions<24`` are whole numbers from 0 to 23, none of them twice in a map of a shape (N, C, H, W).
    """
    if text in GIVEN:
        return GIVEN[text]
    kind, _, size = text.partition(":")
    kind, _, below = kind.partition("<")
    shape = sizes(size)[0]
    if kind == "integers":
        return rng.integers(0, int(below), size=shape)
    if kind == "positions":
        images, channels, height, width = shape
        maps = [rng.permutation(int(below))[: height * width] for _ in range(images * channels)]
        return np.stack(maps).reshape(shape)
    return {"normal": rng.normal, "uniform": rng.uniform}[kind](size=shape)


def _case(row: dict[str, str]) -> Case:
    bottoms, _, fixed = row["bottoms"].partition("/")
    return Case(
        row["dialect"],
        row["layer"],
        bottoms.split(),
        fixed.split(),
        [float(number) for number in row["expected"].split()],
        TRAIN if row["phase"] else TEST,
        int(row["tops"] or 1),
        not row["gradient"],
    )


NUMBERS = [_case(row) for row in read_table("netspec/dialects/cases/numbers.txt")]
