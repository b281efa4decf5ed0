"""R-FCN's losses of the hardest examples, beside plain loops over regions."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from netspec.errors import SpecError
from netspec.layers import Layer

Build = Callable[..., Layer]
Gradcheck = Callable[..., None]


def regions_of(images: list[int]) -> torch.Tensor:
    return torch.tensor([[float(image), 0, 0, 5, 5] for image in images])


def test_the_hardest_regions_of_each_image_are_kept(build: Build) -> None:
    regions, losses = regions_of([0, 1, 0, 1, 0]), torch.tensor([0.5, 3, 0.75, 1, 0.25]).reshape(5, 1, 1, 1)
    labels, weights = torch.tensor([4.0, 3, 2, 1, 0]), torch.arange(10.0).reshape(5, 2)
    text = "type: 'BoxAnnotatorOHEM' box_annotator_ohem_param { roi_per_img: %d ignore_label: -1 }"
    layer = build("rfcn", text % 1, (5, 5), (5, 1, 1, 1), (5,), (5, 2), tops=2)
    kept, chosen = layer.run(regions, losses, labels, weights)
    assert kept.flatten().tolist() == [-1, 3, 2, -1, -1]
    assert chosen.reshape(5, 2).tolist() == [[0, 0], [2, 3], [4, 5], [0, 0], [0, 0]]
    assert layer.top_shapes == [(5, 1, 1, 1), (5, 2, 1, 1)] == [tuple(kept.shape), tuple(chosen.shape)]
    layer = build("rfcn", text % 2, (5, 5), (5, 1, 1, 1), (5,), (5, 2), tops=2)
    assert layer.run(regions, losses, labels, weights)[0].flatten().tolist() == [4, 3, 2, 1, -1]


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(
    ("loss_param", "divisor"),
    [
        ("", 5),
        ("loss_param { normalization: PRE_FIXED pre_fixed_normalizer: 128 }", 128),
        ("loss_param { normalization: PRE_FIXED }", 1),
        ("loss_param { normalization: NONE }", 1),
        ("loss_param { normalize: false }", 5),
    ],
)
def test_smooth_l1_of_regions(
    build: Build, gradcheck: Gradcheck, weighted: bool, loss_param: str, divisor: int
) -> None:
    predictions, targets, weights = torch.randn(3, 5, 4) * 2
    weights = (weights > 0).float()  # R-FCN's; the gradient leaves weights out
    bottoms = (predictions, targets, weights)[: 2 + weighted]
    layer = build("rfcn", f"type: 'SmoothL1LossOHEM' {loss_param}", *(b.shape for b in bottoms), tops=2)
    loss, each = layer.run(*bottoms)
    d = ((predictions - targets) * (weights if weighted else 1)).numpy()
    expected = np.where(abs(d) < 1, d * d / 2, abs(d) - 0.5).sum(axis=1)
    np.testing.assert_allclose(each.flatten(), expected, rtol=1e-5)
    np.testing.assert_allclose(loss, expected.sum() / divisor, rtol=1e-5)
    assert each.shape == (5, 1, 1, 1)
    gradcheck(layer, *bottoms, fixed=(2,))


@pytest.mark.parametrize(("given", "divisor"), [("", 3), ("normalization: PRE_FIXED pre_fixed_normalizer: 16", 16)])
def test_softmax_loss_of_each_region(build: Build, given: str, divisor: int) -> None:
    scores, labels = torch.randn(4, 3), torch.tensor([2.0, -1, 0, 1])
    text = f"type: 'SoftmaxWithLossOHEM' loss_param {{ ignore_label: -1 {given} }}"
    layer = build("rfcn", text, (4, 3), (4,), tops=3)
    loss, p, each = layer.run(scores.requires_grad_(), labels)
    expected = F.cross_entropy(scores, labels.long(), reduction="none", ignore_index=-1)
    torch.testing.assert_close(each, expected.detach())
    torch.testing.assert_close(p, F.softmax(scores, 1).detach())
    torch.testing.assert_close(loss, expected.sum() / divisor)
    (found,) = torch.autograd.grad(loss, scores)
    torch.testing.assert_close(found, torch.autograd.grad(expected.sum() / divisor, scores)[0])


def test_bottoms_of_other_shapes_are_refused(build: Build) -> None:
    with pytest.raises(SpecError, match=r"found shape \(4, 1, 1, 1\), expected \(5, 1\)"):
        build(
            "rfcn",
            "type: 'BoxAnnotatorOHEM' box_annotator_ohem_param { roi_per_img: 1 }",
            (5, 5),
            (4, 1, 1, 1),
            (5,),
            (5, 2),
            tops=2,
        )
    with pytest.raises(SpecError, match="roi_per_img must be given and be at least 1"):
        build(
            "rfcn",
            "type: 'BoxAnnotatorOHEM' box_annotator_ohem_param { roi_per_img: 0 }",
            (5, 5),
            (5, 1, 1, 1),
            (5,),
            (5, 2),
            tops=2,
        )
    with pytest.raises(SpecError, match=r"found bottoms of shapes \(5, 8\) and \(5, 4\)"):
        build("rfcn", "type: 'SmoothL1LossOHEM'", (5, 8), (5, 4))
