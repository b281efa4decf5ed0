"""Layers of face recognition and related forks compared with their formulas, where no golden file has the case."""

import math

import numpy as np
import pytest
import torch

import netspec
from netspec.dialects.faces.margins import MARGINS
from netspec.errors import SpecError

MAP = [[[[1.0, 2], [3, 4]]]]


@pytest.fixture(autouse=True)
def of_faces() -> None:
    for dialect in ("faces", "happynear", "flownet", "blocks"):
        netspec.use_dialect(dialect)


@pytest.mark.parametrize("times", [2, 3, 4])
def test_margins_are_cosines_that_decrease_monotonically(times: int) -> None:
    margin = MARGINS[times - 1]
    assert margin
    angles = torch.linspace(0.01, math.pi - 0.01, 400, dtype=torch.double)
    part = (angles * times / math.pi).floor()
    found, slope = margin(angles.cos())
    torch.testing.assert_close(found, (-1) ** part * (times * angles).cos() - 2 * part)
    assert (found.diff() < 0).all()
    cosine = angles.cos().requires_grad_()
    torch.testing.assert_close(torch.autograd.grad(margin(cosine)[0].sum(), cosine)[0], slope)


@pytest.mark.parametrize("kind", ["SINGLE", "DOUBLE", "TRIPLE", "QUADRUPLE"])
def test_large_margin_inner_product_gradient_is_the_derivative(kind: str) -> None:
    layer = netspec.layer(
        f'type: "LargeMarginInnerProduct" largemargin_inner_product_param {{ num_output: 4 type: {kind} base: 2 '
        'weight_filler { type: "gaussian" std: 1 } }'
    )
    x, labels = torch.randn(5, 3, dtype=torch.double, requires_grad=True), torch.tensor([0.0, 1, 2, 3, 1])
    layer(x.float(), labels)
    assert torch.autograd.gradcheck(layer.double(), (x, labels))


@pytest.mark.parametrize("kind", ["TRIPLE", "QUADRUPLE"])
def test_margin_inner_product_computes_its_formula_with_a_bounded_gradient(kind: str) -> None:
    text = f"num_output: 3 type: {kind} base: 3 power: 0 weight_filler {{ type: 'gaussian' std: 1 }}"
    layer = netspec.layer(f'type: "MarginInnerProduct" margin_inner_product_param {{ {text} }}')
    x, labels = torch.randn(4, 5, requires_grad=True), torch.tensor([2.0, 0, 1, 2])
    top = layer(x, labels)
    weight = next(layer.parameters()).detach()
    torch.testing.assert_close(weight.norm(dim=1), torch.ones(3))
    plain, rows = x.detach() @ weight.t(), torch.arange(4)
    length, margin = x.detach().norm(dim=1), MARGINS[2 if kind == "TRIPLE" else 3]
    assert margin
    chosen = plain[rows, labels.long()]
    plain[rows, labels.long()] = (length * margin(chosen / length)[0] + 3 * chosen) / 4
    torch.testing.assert_close(top, plain)
    top[0, 2].backward()
    assert x.grad is not None
    assert (4 * x.grad[0] - 3 * weight[2]).square().sum() <= 4  # of w and x, each by its share of a length of 1


@pytest.mark.parametrize(
    ("text", "found", "expected"),
    [
        ('type: "Flip"', MAP, [[[[2.0, 1], [4, 3]]]]),
        ('type: "Flip" flip_param { flip_width: false flip_height: true }', MAP, [[[[3.0, 4], [1, 2]]]]),
        ('type: "Mean" mean_param { operation: SUBTRACT value: 1 input_scale: 2 }', MAP, [[[[1.0, 3], [5, 7]]]]),
        ('type: "Mean" mean_param { operation: ADD value: 1 value: 2 output_scale: 2 }',
         [[[[1.0]], [[3]]]], [[[[4.0]], [[10]]]]),
        ('type: "NegReLU" relu_param { negative_slope: 0.5 }', [-2.0, 0, 2], [-2.0, 0, 1]),
        ('type: "L1Loss" l1_loss_param { normalize_by_num_entries: true }', [[1.0, math.nan], [3, -4]], 8 / 1.5),
        ('type: "L1Loss" l1_loss_param { l2_per_location: true epsilon: 0 }', [[3.0, 4], [0, 0]], 2.5),
        ('type: "L1Loss" l1_loss_param { l2_per_location: true l2_prescale_by_channels: true epsilon: 0 plateau: 2 }',
         [[3.0, 4], [1, 1]], 12.5**0.5 / 2),
    ],
    ids=["Flip", "Flip_height", "Mean_SUBTRACT", "Mean_ADD", "NegReLU", "L1Loss", "L1Loss_l2", "L1Loss_plateau"],
)  # fmt: skip
def test_layers_of_one_bottom_compute_the_given_values(text: str, found: object, expected: object) -> None:
    top = netspec.layer(text)(torch.tensor(found))
    torch.testing.assert_close(top, torch.tensor(expected))


def test_inner_product_with_normalize_has_weights_of_length_one() -> None:
    fields = "num_output: 3 normalize: true bias_term: false weight_filler { type: 'gaussian' std: 1 }"
    layer = netspec.layer(f'type: "InnerProduct" inner_product_param {{ {fields} }}')
    x = torch.randn(2, 4)
    top = layer(x)
    torch.testing.assert_close(next(layer.parameters()).norm(dim=1), torch.ones(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(top, x @ next(layer.parameters()).t())


def test_channel_scale_without_backward_scale_and_with_global_scale() -> None:
    x, scale = torch.randn(2, 3, 2, 2, requires_grad=True), torch.rand(2, 1, 2, 2, requires_grad=True)
    top = netspec.layer('type: "ChannelScale" channel_scale_param { do_backward_scale: false }')(x, scale)
    torch.testing.assert_close(top, x * scale)
    top.sum().backward()
    assert x.grad is not None
    assert scale.grad is not None
    torch.testing.assert_close(x.grad, scale.detach().expand_as(x))
    assert not scale.grad.any()
    tops = netspec.layer(
        'type: "ChannelScale" top: "y" top: "s" phase: TRAIN channel_scale_param { global_scale: true }'
    )(x, scale)
    torch.testing.assert_close(tops[1][0], scale.mean())
    torch.testing.assert_close(tops[0], x * scale.mean())


def test_label_specific_add_adds_a_growing_bias_to_the_labels_score() -> None:
    fields = "bias_base: 0 bias_gamma: 1 bias_max: 1.5"
    layer = netspec.layer(f'type: "LabelSpecificAdd" phase: TRAIN label_specific_add_param {{ {fields} }}')
    scores, labels = torch.tensor([[1.0, 2], [-3, 4]]), torch.tensor([1.0, 0])
    for bias in (0, 1, 1.5):
        torch.testing.assert_close(layer(scores, labels), torch.tensor([[1.0, 2 + bias], [-3, 4]]))
    with pytest.raises(SpecError, match="found a label outside 0 to 1"):
        layer(scores, torch.tensor([2.0, 0]))


@pytest.mark.parametrize(
    ("fields", "bias"),
    [
        ("iteration: 2 bias_gamma: -1 bias_power: 0.5", math.nan),
        ("iteration: 1 bias_gamma: -1 bias_power: -1", math.inf),
        ("iteration: 1 bias_gamma: 1e30 bias_power: 20", math.inf),
    ],
    ids=["root_of_a_negative_number", "inverse_of_zero", "overflow"],
)
def test_label_specific_adds_bias_is_that_of_cs_pow(fields: str, bias: float) -> None:
    given = f"label_specific_add_param {{ bias_base: 0 bias_max: inf {fields} }}"
    layer = netspec.layer(f'type: "LabelSpecificAdd" top: "y" top: "bias" phase: TRAIN {given}')
    scores = torch.tensor([[1.0, 2]])
    top, found = layer(scores, torch.tensor([1.0]))
    torch.testing.assert_close(found, torch.tensor([bias]), equal_nan=True)
    torch.testing.assert_close(top, torch.tensor([[1.0, 2.0 if math.isnan(bias) else bias]]))  # NaN is not added


def test_focal_loss_of_both_types_computes_its_formula() -> None:
    scores, labels = torch.randn(3, 4), torch.tensor([0.0, 3, 1])
    p = scores.softmax(1)[range(3), labels.long()]
    for kind, factor in (("ORIGIN", (1 - p) ** 3), ("ONEADDP", (1 + p) ** 3)):
        layer = netspec.layer(f'type: "FocalLoss" focal_loss_param {{ type: {kind} gamma: 3 }}')
        torch.testing.assert_close(layer(scores, labels), (-factor * p.log()).mean())


def test_seg_accuracy_counts_pixels_and_refuses_invalid_labels() -> None:
    scores, labels = torch.randn(2, 3, 4, 5), torch.randint(0, 3, (2, 1, 4, 5)).float()
    labels[0, 0, 0, 0] = 255
    layer = netspec.layer('type: "SegAccuracy" seg_accuracy_param { ignore_label: 255 reset: false }')
    table = np.zeros((3, 3))
    for n, y, x in np.ndindex(2, 4, 5):
        if labels[n, 0, y, x] != 255:
            table[int(labels[n, 0, y, x]), int(scores[n, :, y, x].argmax())] += 1
    right = np.diag(table)
    expected = [right.sum() / table.sum(), (right / table.sum(1)).mean()]
    expected.append((right / (table.sum(0) + table.sum(1) - right)).mean())
    for _ in range(2):  # twice the same counts
        np.testing.assert_allclose(layer(scores, labels).flatten(), expected, rtol=1e-6)
    with pytest.raises(SpecError, match="found a label outside 0 to 2; write it as ignore_label"):
        layer(scores, labels + 1)
