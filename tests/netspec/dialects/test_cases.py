"""Layers of dialects: their numbers (cases/numbers.txt), and what they refuse (cases/refused.txt)."""

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch

from case_files import read_table, sizes
from contexts import context
from dialect_numbers import NUMBERS, Case
from netspec import use_dialect
from netspec.errors import SpecError, Where
from netspec.layers import Context, Layer
from netspec.net.one_layer import make_layer
from netspec.proto.schema import TEST, TRAIN

REFUSED = read_table("netspec/dialects/cases/refused.txt")


def coefficients(like: torch.Tensor) -> torch.Tensor:
    return torch.tensor(np.random.default_rng(like.numel()).uniform(-1, 1, like.shape), dtype=torch.float64)


def weighted_sum(values: torch.Tensor) -> tuple[float, float]:
    """Return the sum of values times fixed coefficients, and the tolerance for rounding."""
    parts = values.detach().double().nan_to_num(7) * coefficients(values)
    return float(parts.sum()), 3e-5 * float(parts.abs().sum()) + 1e-7


def run_case(case: Case) -> tuple[list[tuple[float, float]], Layer, list[torch.Tensor], tuple[int, ...]]:
    """Run a case; return its results, the layer, its bottoms, and which of these get no gradient."""
    rng = np.random.default_rng(5)
    bottoms = [torch.tensor(x, dtype=torch.float32) for x in case.arrays(rng)]
    use_dialect(case.dialect)
    layer = make_layer(case.layer, [tuple(each.shape) for each in bottoms], Context(case.phase), case.tops)
    for blob in layer.blobs:
        blob.data.copy_(torch.tensor(rng.uniform(0.5, 1.5, blob.shape)))
    inputs = [each.requires_grad_(i < len(case.bottoms)) for i, each in enumerate(bottoms)]
    before = [blob.detach().clone() for blob in layer.blobs]
    tops = layer.run(*inputs)
    assert layer.counted_axis is not None or [tuple(top.shape) for top in tops] == layer.top_shapes
    found = [weighted_sum(top) for top in tops]
    learned = [top for top in tops if top.requires_grad]
    if learned:
        torch.autograd.backward(learned, [coefficients(top).to(top) for top in learned])
        found += [weighted_sum(each.grad) for each in (*inputs, *layer.blobs) if each.grad is not None]
    found += [weighted_sum(b) for b, a in zip(layer.blobs, before, strict=True) if not torch.equal(a, b)]
    return found, layer, [each.detach() for each in bottoms], tuple(range(len(case.bottoms), len(bottoms)))


@pytest.mark.parametrize("case", NUMBERS, ids=[f"{i} {case.type_name}" for i, case in enumerate(NUMBERS)])
def test_layer_results_equal_those_of_plain_loops(case: Case, gradcheck: Callable[..., None]) -> None:
    found, layer, bottoms, fixed = run_case(case)
    line = " ".join(f"{value:.7g}" for value, _ in found)
    assert len(found) == len(case.expected), line
    assert all(abs(a - b) <= slack for (a, slack), b in zip(found, case.expected, strict=True)), line
    assert type(copy.deepcopy(layer)) is type(layer)
    if case.is_derivative and len(found) > len(layer.top_shapes):
        gradcheck(layer, *bottoms, fixed=fixed)


@pytest.mark.parametrize(
    "case", REFUSED, ids=[f"{i} {case['dialect']} {case['field']}" for i, case in enumerate(REFUSED)]
)
def test_invalid_fields_and_bottoms_are_refused_at_their_place(case: dict[str, str]) -> None:
    use_dialect(case["dialect"])
    where = context(phase=TRAIN if case["phase"] else TEST, at=lambda *path: Where(".".join(map(str, path))))
    with pytest.raises(SpecError) as caught:
        make_layer(case["layer"], sizes(case["bottoms"]), where, int(case["tops"] or 1))
    fault = caught.value
    assert (fault.where.file if fault.where else "") == case["field"]
    assert len(str(fault).splitlines()) == 1


@pytest.mark.parametrize(
    ("dialect", "line"),
    [
        ("rfcn", "type: 'SmoothL1LossOHEM' top: 'a' top: 'b'"),
        ("happynear", "type: 'LabelSpecificAdd' label_specific_add_param { bias: -0.5 }"),
    ],
    ids=["SmoothL1LossOHEM", "LabelSpecificAdd"],
)
def test_a_bottom_of_one_axis_has_one_channel(dialect: str, line: str) -> None:
    use_dialect(dialect)
    scores, other = torch.tensor([0.5, -2.0, 1.0]), torch.zeros(3)
    shapes = [((3,), (3,)), ((3, 1), (3, 1))]
    tops = [
        make_layer(line, each, Context(TRAIN), line.count("top:") or 1).run(scores.view(each[0]), other.view(each[1]))
        for each in shapes
    ]
    for one, two in zip(*tops, strict=True):
        assert torch.equal(one.flatten(), two.flatten())
