"""The losses and Accuracy compared with plain loops in numpy, and with Caffe's results in special cases."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from netspec.data.blobs import from_array
from netspec.errors import SpecError

FLT_MIN = np.finfo(np.float32).tiny
FULL, VALID, BATCH_SIZE, NONE = "FULL", "VALID", "BATCH_SIZE", "NONE"


def softmax(x: np.ndarray, axis: int = 1) -> np.ndarray:
    e = np.exp(x - x.max(axis, keepdims=True))
    return e / e.sum(axis, keepdims=True)


def normalizer(mode: str, outer: int, inner: int, valid: int) -> int:
    return max(1, {FULL: outer * inner, VALID: valid, BATCH_SIZE: outer, NONE: 1}[mode])


def value_and_gradient(layer, *bottoms: torch.Tensor) -> tuple[float, np.ndarray]:
    first = bottoms[0].clone().requires_grad_()
    loss = layer.run(first, *bottoms[1:])[0]
    assert loss.shape == ()
    loss.backward()
    assert first.grad is not None
    return loss.item(), first.grad.numpy()


# SoftmaxWithLoss


def softmax_loss(x: np.ndarray, labels: np.ndarray, mode: str, ignore: int | None) -> tuple[float, np.ndarray]:
    """Caffe's loops; x (outer, classes, inner), labels (outer, inner)."""
    p = softmax(x)
    total, valid, grad = 0.0, 0, p.copy()
    for i, j in np.ndindex(*labels.shape):
        label = int(labels[i, j])
        if label == ignore:
            grad[i, :, j] = 0
            continue
        total -= math.log(max(p[i, label, j], FLT_MIN))
        grad[i, label, j] -= 1
        valid += 1
    outer, inner = labels.shape
    scale = normalizer(mode, outer, inner, valid)
    return total / scale, grad / scale


@pytest.mark.parametrize("ignore", [None, 2, 255])
@pytest.mark.parametrize("mode", [FULL, VALID, BATCH_SIZE, NONE])
def test_softmax_with_loss_in_every_normalization(build, mode: str, ignore: int | None) -> None:
    given = "" if ignore is None else f"ignore_label: {ignore}"
    layer = build(f'type: "SoftmaxWithLoss" loss_param {{ normalization: {mode} {given} }}', (3, 4, 2, 5), (3, 2, 5))
    x = torch.randn(3, 4, 2, 5)
    labels = torch.randint(0, 4, (3, 2, 5)).float()
    if ignore is not None:
        labels[torch.rand(3, 2, 5) < 0.3] = ignore
    loss, grad = value_and_gradient(layer, x, labels)
    expected = softmax_loss(x.double().reshape(3, 4, 10).numpy(), labels.reshape(3, 10).numpy(), mode, ignore)
    assert loss == pytest.approx(expected[0], rel=1e-6)
    np.testing.assert_allclose(grad.reshape(3, 4, 10), expected[1], atol=1e-7)


def test_softmax_with_loss_clamps_the_probability_at_flt_min_but_not_its_gradient(build) -> None:
    layer = build('type: "SoftmaxWithLoss"', (1, 2), (1,))
    loss, grad = value_and_gradient(layer, torch.tensor([[200.0, 0.0]]), torch.tensor([1.0]))
    assert loss == pytest.approx(87.33655, abs=1e-5)
    assert grad.tolist() == [[1, -1]]


@pytest.mark.parametrize(
    ("loss_param", "divisor"),
    [
        ("", 12),  # VALID
        ("normalize: false", 4),  # BATCH_SIZE
        ("normalize: true", 12),
        ("normalize: false normalization: FULL", 12),  # normalization wins
        ("normalize: true normalization: NONE", 1),
    ],
    ids=["default", "normalize_false", "normalize_true", "false_and_FULL", "true_and_NONE"],
)
def test_normalize_is_ignored_if_normalization_is_set(build, loss_param: str, divisor: int) -> None:
    layer = build(f'type: "SoftmaxWithLoss" loss_param {{ {loss_param} }}', (4, 2, 3), (4, 3))
    loss = layer.run(torch.zeros(4, 2, 3), torch.zeros(4, 3))[0].item()
    assert loss == pytest.approx(12 * math.log(2) / divisor)


def test_softmax_with_loss_of_ignored_labels_only_is_zero(build) -> None:
    layer = build('type: "SoftmaxWithLoss" loss_param { ignore_label: -1 }', (2, 3), (2,))
    loss, grad = value_and_gradient(layer, torch.randn(2, 3), torch.tensor([-1.0, -1.0]))
    assert (loss, np.abs(grad).max()) == (0, 0)


def test_softmax_with_loss_along_another_axis_equals_plain_loops(build) -> None:
    layer = build('type: "SoftmaxWithLoss" softmax_param { axis: -1 }', (2, 3, 4), (2, 3, 1))
    x, labels = torch.randn(2, 3, 4), torch.randint(0, 4, (2, 3, 1)).float()
    expected, grad = softmax_loss(x.double().reshape(6, 4, 1).numpy(), labels.reshape(6, 1).numpy(), VALID, None)
    found = value_and_gradient(layer, x, labels)
    assert found[0] == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(found[1], grad.reshape(2, 3, 4), atol=1e-7)


@pytest.mark.parametrize("kind", ["SoftmaxWithLoss", "InfogainLoss"])
def test_second_top_is_the_softmax_and_brings_no_gradient(build, kind: str) -> None:
    bottoms = [torch.randn(2, 3, 4), torch.zeros(2, 4), torch.eye(3)][: 2 + (kind == "InfogainLoss")]
    layer = build(f'type: "{kind}"', *(tuple(b.shape) for b in bottoms), tops=2)
    assert layer.top_shapes == [(), (2, 3, 4)]
    bottoms[0].requires_grad_()
    loss, p = layer.run(*bottoms)
    assert loss.requires_grad
    assert not p.requires_grad
    torch.testing.assert_close(p, torch.softmax(bottoms[0].detach(), 1))


def test_a_loss_layer_without_a_top_gets_one(build) -> None:
    layer = build('type: "SoftmaxWithLoss"', (2, 3), (2,), tops=0)
    assert layer.top_shapes == [()]
    assert len(layer.run(torch.randn(2, 3), torch.zeros(2))) == 1


# InfogainLoss


@pytest.mark.parametrize("ignore", ["", "ignore_label: 1"], ids=["all", "ignoring"])
def test_infogain_loss_with_a_matrix_from_a_file_equals_softmax_with_loss(build, tmp_path: Path, ignore: str) -> None:
    """The matrix is the identity; the golden case has another one, as a bottom."""
    source = tmp_path / "h.binaryproto"
    source.write_bytes(from_array(np.eye(3, dtype=np.float32).reshape(1, 1, 3, 3)).SerializeToString())
    x, labels = torch.randn(2, 4, 3), torch.randint(0, 3, (2, 4)).float()
    found = []
    for text in (f'"InfogainLoss" infogain_loss_param {{ axis: 2 source: "{source}" }}',
                 '"SoftmaxWithLoss" softmax_param { axis: 2 }'):  # fmt: skip
        layer = build(f"type: {text} loss_param {{ {ignore} }}", (2, 4, 3), (2, 4))
        found.append(value_and_gradient(layer, x, labels))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-6)


def test_infogain_loss_clamps_the_probability_at_1e_20_but_not_its_gradient(build) -> None:
    layer = build('type: "InfogainLoss"', (1, 2), (1,), (2, 2))
    gain = torch.tensor([[0.0, 0.0], [0.0, 2.0]])
    loss, grad = value_and_gradient(layer, torch.tensor([[200.0, 0.0]]), torch.tensor([1.0]), gain)
    assert loss == pytest.approx(2 * 20 * math.log(10), rel=1e-6)
    assert grad.tolist() == [[2, -2]]


# MultinomialLogisticLoss


def test_multinomial_loss_clamps_the_probability_at_1e_20_for_the_gradient_too(build) -> None:
    layer = build('type: "MultinomialLogisticLoss"', (2, 3, 1, 1), (2,))
    p = torch.tensor([[0.2, 0.3, 0.5], [0.0, 1e-25, 1.0]]).reshape(2, 3, 1, 1)
    loss, grad = value_and_gradient(layer, p, torch.tensor([2.0, 1.0]))
    assert loss == pytest.approx((math.log(2) + 20 * math.log(10)) / 2, rel=1e-6)
    np.testing.assert_allclose(grad.reshape(2, 3), [[0, 0, -1], [0, -5e19, 0]], rtol=1e-6)


# HingeLoss


def test_hinge_loss_has_gradient_zero_exactly_at_the_margin(build) -> None:
    layer = build('type: "HingeLoss"', (1, 2), (1,))
    assert value_and_gradient(layer, torch.tensor([[1.0, -1.0]]), torch.tensor([0.0]))[1].tolist() == [[0, 0]]


# SigmoidCrossEntropyLoss


@pytest.mark.parametrize("ignore", [None, 1])
@pytest.mark.parametrize("mode", [None, FULL, VALID, BATCH_SIZE, NONE])
def test_sigmoid_cross_entropy_in_every_normalization_with_batch_size_as_default(
    build, mode: str | None, ignore: int | None
) -> None:
    given = ("" if mode is None else f"normalization: {mode} ") + ("" if ignore is None else f"ignore_label: {ignore}")
    layer = build(f'type: "SigmoidCrossEntropyLoss" loss_param {{ {given} }}', (3, 4), (3, 4, 1))
    x = torch.randn(3, 4) * 30
    targets = torch.tensor([0.0, 0.3, 1.0, 1.9, 1.0, 0.0, 2.5, 0.5, 1.0, 0.0, 0.0, -0.7])
    valid, total, expected = 0, 0.0, np.zeros(12)
    for i, (v, t) in enumerate(zip(x.flatten().tolist(), targets.tolist(), strict=True)):
        if int(t) == ignore:  # 1.9 is cast to 1
            continue
        total -= v * (t - (v >= 0)) - math.log1p(math.exp(v - 2 * v * (v >= 0)))
        expected[i] = 1 / (1 + math.exp(-v)) - t
        valid += 1
    scale = normalizer(mode or BATCH_SIZE, 3, 4, valid)
    loss, grad = value_and_gradient(layer, x, targets.reshape(3, 4, 1))
    assert loss == pytest.approx(total / scale, rel=1e-6)
    np.testing.assert_allclose(grad.flatten(), expected / scale, atol=1e-6)


@pytest.mark.parametrize(
    ("loss_param", "divisor"), [("normalize: true", 6), ("normalize: false", 2)], ids=["true", "false"]
)
def test_sigmoid_cross_entropy_reads_the_deprecated_normalize(build, loss_param: str, divisor: int) -> None:
    layer = build(f'type: "SigmoidCrossEntropyLoss" loss_param {{ {loss_param} }}', (2, 3), (2, 3))
    assert layer.run(torch.zeros(2, 3), torch.ones(2, 3))[0].item() == pytest.approx(6 * math.log(2) / divisor)


# EuclideanLoss


def test_euclidean_loss_compares_element_by_element_without_broadcasting(build) -> None:
    layer = build('type: "EuclideanLoss"', (3,), (3, 1))
    # Broadcasting (3,) against (3, 1) would give 9 differences.
    assert layer.run(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([[1.0], [2.0], [3.0]]))[0].item() == 0


# ContrastiveLoss


def test_contrastive_loss_backward_divides_by_the_distance_plus_1e_4(build) -> None:
    layer = build('type: "ContrastiveLoss"', (2, 1), (2, 1), (2,))
    a = torch.tensor([[1e-4], [0.0]])
    _, grad = value_and_gradient(layer, a, torch.zeros(2, 1), torch.zeros(2))
    # The derivative would be -(1 - d) / 2 at the first, and nothing finite at the second.
    np.testing.assert_allclose(grad, [[-(1 - 1e-4) / 2e-4 * 1e-4 / 2], [0]], rtol=1e-5)


def test_contrastive_labels_are_cast_to_integers_and_any_but_zero_is_similar(build) -> None:
    layer = build('type: "ContrastiveLoss"', (5, 1), (5, 1), (5,))
    labels = torch.tensor([0.9, -0.9, 1.0, -1.0, 7.3])  # dissimilar twice (cast to 0), then similar
    loss = layer.run(torch.full((5, 1), 0.5), torch.zeros(5, 1), labels)[0].item()
    assert loss == pytest.approx(5 * 0.25 / 10)
    loss = layer.run(torch.full((5, 1), 2.0), torch.zeros(5, 1), labels)[0].item()
    assert loss == pytest.approx(3 * 4 / 10)


# Accuracy


def test_accuracy_counts_ties_against_the_label(build) -> None:
    layer = build('type: "Accuracy"', (3, 3), (3,))
    scores = torch.tensor([[1.0, 1.0, 0.0], [0.0, 2.0, 1.0], [5.0, 5.0, 5.0]])
    assert layer.run(scores, torch.tensor([0.0, 1.0, 0.0]))[0].item() == pytest.approx(1 / 3)
    top2 = build('type: "Accuracy" accuracy_param { top_k: 2 }', (3, 3), (3,))
    assert top2.run(scores, torch.tensor([0.0, 1.0, 0.0]))[0].item() == pytest.approx(2 / 3)


def test_accuracy_leaves_ignored_labels_out_and_is_zero_without_any_other(build) -> None:
    layer = build('type: "Accuracy" accuracy_param { ignore_label: 255 }', (3, 2), (3,), tops=2)
    scores = torch.tensor([[2.0, 1.0], [2.0, 1.0], [2.0, 1.0]])
    accuracy, each = layer.run(scores, torch.tensor([0.0, 1.0, 255.0]))
    assert (accuracy.item(), each.tolist()) == (0.5, [1, 0])
    accuracy, each = layer.run(scores, torch.full((3,), 255.0))
    assert (accuracy.item(), each.tolist()) == (0, [0, 0])


# Several layers


BOTTOMS = {
    "SoftmaxWithLoss": [(4, 3), (4,)],
    "InfogainLoss": [(4, 3), (4,), (3, 3)],
    "MultinomialLogisticLoss": [(4, 3), (4,)],
    "HingeLoss": [(4, 3), (4,)],
    "SigmoidCrossEntropyLoss": [(4, 3), (4, 3)],
    "ContrastiveLoss": [(4, 3), (4, 3), (4,)],
    "Accuracy": [(4, 3), (4,)],
}


@pytest.mark.parametrize(("kind", "shapes"), BOTTOMS.items(), ids=BOTTOMS)
def test_labels_have_no_gradient_and_the_batch_size_can_change(build, kind: str, shapes: list) -> None:
    layer = build(f'type: "{kind}"', *shapes)
    for n in (4, 2):
        bottoms = [torch.rand(n if shape[0] == 4 else 3, *shape[1:], requires_grad=True) for shape in shapes]
        top = layer.run(*bottoms)[0]
        assert top.requires_grad == (kind != "Accuracy")
        if top.requires_grad:
            top.backward()
        assert layer.label_bottoms
        for i in layer.label_bottoms:
            assert bottoms[i].grad is None


@pytest.mark.parametrize("kind", ["SoftmaxWithLoss", "MultinomialLogisticLoss", "HingeLoss", "Accuracy"])
@pytest.mark.parametrize("label", [-1.0, 3.0])
def test_an_invalid_label_is_refused_with_its_value(build, kind: str, label: float) -> None:
    layer = build(f'type: "{kind}"', (2, 3), (2,))
    with pytest.raises(SpecError, match=rf"found label {label:g}, expected 0 to 2: the scores have 3 classes"):
        layer.run(torch.rand(2, 3), torch.tensor([0.0, label]))


def test_an_unreadable_infogain_matrix_is_refused_with_its_path(build, tmp_path: Path) -> None:
    for name, content in (("absent", None), ("broken", b"\xff\xff\xff")):
        source = tmp_path / name
        if content is not None:
            source.write_bytes(content)
        with pytest.raises(SpecError, match=rf'infogain_loss_param.source: cannot read the infogain matrix "{source}"'):
            build(f'type: "InfogainLoss" infogain_loss_param {{ source: "{source}" }}', (4, 3), (4,))
