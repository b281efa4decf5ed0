"""Layers of dialects: their numbers, which plain loops over boxes, pixels and paths found, and what they refuse.

The loops stood in the tests until they had agreed; what they found stands in cases/numbers.txt. (What the forks found
is in test_forks_golden.py.) A case is a line of the dialect, the phase if it is TRAIN, how many tops if there are
several, and the layer; then a line of the bottoms and, in cases/refused.txt, the fault; else what is found: of each top
the sum of its numbers times fixed ones, the same of the gradient of each bottom and blob, and of each blob that the
pass changed.

A bottom is a shape of random numbers (``2x3``), with ``+`` from 0 to 1, with ``<4`` whole ones below 4, with ``@6``
whole ones below 6, each once a map; ``=name`` is one of the arrays below. Those behind ``!`` get no gradient. ``~``
before the dialect says that the gradient is not the derivative.
"""

import copy
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from netspec.dialects import use_dialect
from netspec.errors import SpecError
from netspec.layers import Context, Layer
from netspec.net.one_layer import make_layer
from netspec.proto.schema import TEST, TRAIN

Case = tuple[str, ...]
NOT_OF_WORDS = re.compile(r"\W+")


def cases(file: str) -> list[Case]:
    """Return mark, dialect, phase, tops, layer, bottoms and the rest of each case."""
    text = (Path(__file__).parent / "cases" / file).read_text()
    found = re.findall(r"^(~?)(\w+)( TRAIN|)(?: (\d)|) (type: .*)\n  (.*) -> (.*)$", text, re.MULTILINE)
    assert 2 * len(found) == len(text.splitlines()) - 1, "a line that is none of a case"
    return found


def names(found: list[Case]) -> list[str]:
    return [f"{i} {re.split(NOT_OF_WORDS, case[4])[1]}" for i, case in enumerate(found)]


NUMBERS, REFUSED = cases("numbers.txt"), cases("refused.txt")
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
    """Boxes, some of which lie partly outside, and variances: (1, 2, 4 count)."""
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


def bottom(word: str, rng: np.random.Generator) -> torch.Tensor:
    """Return the numbers that a word of a case stands for."""
    if word.startswith("="):
        return torch.tensor(GIVEN[word[1:]], dtype=torch.float32)
    sizes, kind, most = re.fullmatch(r"([\dx]+)([+<@]?)(\d*)", word).groups()  # type: ignore[union-attr]
    shape = tuple(map(int, sizes.split("x")))
    if kind == "@":
        maps = [rng.permutation(int(most))[: shape[2] * shape[3]] for _ in range(shape[0] * shape[1])]
        return torch.tensor(np.stack(maps), dtype=torch.float32).reshape(shape)
    drawn = {"": rng.normal, "+": rng.uniform, "<": lambda size: rng.integers(0, int(most), size)}[kind](size=shape)
    return torch.tensor(drawn, dtype=torch.float32)


def weights(like: torch.Tensor) -> torch.Tensor:
    return torch.tensor(np.random.default_rng(like.numel()).uniform(-1, 1, like.shape), dtype=torch.float64)


def summed(values: torch.Tensor) -> tuple[float, float]:
    """Return the sum of numbers times fixed ones, and how far from it rounding may bring it."""
    parts = values.detach().double().nan_to_num(7) * weights(values)
    return float(parts.sum()), 3e-5 * float(parts.abs().sum()) + 1e-7


def made(case: Case, shapes: Sequence[Sequence[int]]) -> Layer:
    _, dialect, phase, tops, text, *_ = case
    use_dialect(dialect)
    return make_layer(text, [tuple(s) for s in shapes], Context(TRAIN if phase else TEST), int(tops or 1))


def find(case: Case) -> tuple[list[tuple[float, float]], Layer, list[torch.Tensor], tuple[int, ...]]:
    """Run a case: what is found, the layer, its bottoms, and which of these get no gradient."""
    rng, (first, _, fixed) = np.random.default_rng(5), (words.split() for words in case[5].partition("!"))
    bottoms = [bottom(word, rng) for word in (*first, *fixed)]
    layer = made(case, [each.shape for each in bottoms])
    for blob in layer.blobs:
        blob.data.copy_(torch.tensor(rng.uniform(0.5, 1.5, blob.shape)))
    inputs = [each.requires_grad_(i < len(first)) for i, each in enumerate(bottoms)]
    before = [blob.detach().clone() for blob in layer.blobs]
    tops = layer.run(*inputs)
    assert layer.counted_axis is not None or [tuple(top.shape) for top in tops] == layer.top_shapes
    found = [summed(top) for top in tops]
    learned = [top for top in tops if top.requires_grad]
    if learned:
        torch.autograd.backward(learned, [weights(top).to(top) for top in learned])
        found += [summed(each.grad) for each in (*inputs, *layer.blobs) if each.grad is not None]
    found += [summed(b) for b, a in zip(layer.blobs, before, strict=True) if not torch.equal(a, b)]
    return found, layer, [each.detach() for each in bottoms], tuple(range(len(first), len(bottoms)))


@pytest.mark.parametrize("case", NUMBERS, ids=names(NUMBERS))
def test_the_numbers_are_those_of_the_loops(case: Case, gradcheck: Callable[..., None]) -> None:
    found, layer, bottoms, fixed = find(case)
    line = " ".join(f"{value:.7g}" for value, _ in found)
    expected = [float(word) for word in case[6].split()]
    assert len(found) == len(expected), line
    assert all(abs(a - b) <= slack for (a, slack), b in zip(found, expected, strict=True)), line
    assert type(copy.deepcopy(layer)) is type(layer)
    if not case[0] and len(found) > len(layer.top_shapes):
        gradcheck(layer, *bottoms, fixed=fixed)


@pytest.mark.parametrize("case", REFUSED, ids=names(REFUSED))
def test_it_is_refused_at_its_place(case: Case) -> None:
    with pytest.raises(SpecError) as fault:
        made(case, [tuple(map(int, word.split("x"))) for word in case[5].split()])
    assert str(fault.value) == case[6]
