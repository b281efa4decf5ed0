"""Activation layers: their formulas, their gradients, and Caffe's results in special cases."""

import math

import numpy as np
import pytest
import torch

from netspec.errors import SpecError
from netspec.fast.kernels import Learning
from netspec.fast.table import learning_kernels

X = torch.tensor([-70.0, -3.0, -0.4, 0.0, 0.2, 1.0, 2.5, 70.0])


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


FORMULAS = {  # id: layer, its formula; golden files have the other ones
    "PReLU": ('type: "PReLU" prelu_param { channel_shared: true }', lambda x: np.where(x > 0, x, 0.25 * x)),
    "Power_linear": ('type: "Power" power_param { scale: 3 shift: -1 }', lambda x: 3 * x - 1),
    "Exp_e": ('type: "Exp" exp_param { scale: 0.1 shift: 0.5 }', lambda x: np.exp(0.1 * x + 0.5)),
    "Log_e": ('type: "Log" log_param { shift: 71 }', lambda x: np.log(x + 71)),
    "Swish": ('type: "Swish"', lambda x: x * sigmoid(x)),
}


@pytest.mark.parametrize(("text", "formula"), FORMULAS.values(), ids=FORMULAS)
def test_activation_computes_its_formula(build, text: str, formula) -> None:
    layer = build(text, (2, 4))
    top = layer.run(X.reshape(2, 4))[0]
    assert layer.top_shapes == [(2, 4)]
    expected = formula(X.double().numpy()).reshape(2, 4)
    np.testing.assert_allclose(top.detach().numpy(), expected, rtol=1e-6, atol=1e-6)


def gradient_at(layer, x: float) -> float:
    bottom = torch.tensor([[x]], requires_grad=True)
    layer.run(bottom)[0].sum().backward()
    assert bottom.grad is not None
    return bottom.grad.item()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('type: "ReLU"', 0),
        ('type: "ReLU" relu_param { negative_slope: 0.5 }', 0.5),
        ('type: "PReLU"', 0.25),
        ('type: "ELU" elu_param { alpha: 3 }', 3),
        ('type: "AbsVal"', 0),
    ],
    ids=["ReLU", "ReLU_slope", "PReLU", "ELU", "AbsVal"],
)
def test_gradient_at_zero_is_that_of_negative_inputs(build, text: str, expected: float) -> None:
    assert gradient_at(build(text, (1, 1)), 0.0) == expected


def test_elu_computes_exp_minus_one_without_expm1(build) -> None:
    x = torch.tensor([[-1e-4]])
    assert build('type: "ELU"', (1, 1)).run(x)[0].item() == (torch.exp(x) - 1).item() != torch.expm1(x).item()


def test_threshold_is_zero_at_the_threshold_and_has_no_gradient(build) -> None:
    layer = build('type: "Threshold" threshold_param { threshold: 0.5 }', (3,))
    top = layer.run(torch.tensor([0.4, 0.5, 0.6], requires_grad=True))[0]
    assert top.tolist() == [0, 0, 1]
    assert not top.requires_grad


def test_clip_passes_gradients_at_min_and_max(build) -> None:
    layer = build('type: "Clip" clip_param { min: -0.5 max: 0.75 }', (1, 1))
    assert [gradient_at(layer, x) for x in (-0.75, -0.5, 0.0, 0.75, 1.0)] == [0, 1, 1, 1, 0]


@pytest.mark.parametrize(
    ("text", "value"),
    [("power: 0 shift: -2", 1), ("power: 3 scale: 0 shift: 2", 8), ("power: 0 scale: 0", 1)],
    ids=["power_0", "scale_0", "both_0"],
)
def test_power_ignores_the_bottom_where_scale_or_power_is_zero(build, text: str, value: float) -> None:
    layer = build(f'type: "Power" power_param {{ {text} }}', (3,))
    assert layer.run(torch.tensor([math.nan, math.inf, 1.0]))[0].tolist() == [value] * 3


def test_power_without_shift_has_gradient_zero_at_zero(build) -> None:
    # Caffe's is power * top / bottom: 0 / 0.
    assert gradient_at(build('type: "Power" power_param { power: 3 }', (1, 1)), 0.0) == 0
    assert gradient_at(build('type: "Power" power_param { power: 2 scale: 5 }', (1, 1)), 0.0) == 0


def test_exp_with_a_large_shift_overflows_to_infinity_only_where_the_result_does(build) -> None:
    layer = build('type: "Exp" exp_param { shift: 1000 }', (2,))
    top = layer.run(torch.tensor([-1000.0, 0.0]))[0]
    assert top.tolist() == [1, math.inf]


@pytest.mark.parametrize("shared", ["false", "true"], ids=["per_channel", "shared"])
@pytest.mark.parametrize(
    "shape",
    [(2, 3, 5, 4), (3, 7), (4, 6, 20, 21), (2, 3, 40, 40, 2), (5, 9, 1, 1)],
    ids=lambda shape: "x".join(map(str, shape)),
)
@pytest.mark.parametrize("channels_last", [False, True], ids=["contiguous", "channels_last"])
def test_prelu_training_kernels_equal_autograd_bit_for_bit(
    build, shape: tuple[int, ...], shared: str, channels_last: bool
) -> None:
    layer = build(f'type: "PReLU" prelu_param {{ channel_shared: {shared} }}', shape, exact="small")
    x, diff = torch.randn(shape), torch.randn(shape)
    if channels_last and len(shape) == 4:
        x, diff = x.contiguous(memory_format=torch.channels_last), diff.contiguous(memory_format=torch.channels_last)
    x[(0,) * len(shape)] = math.nan if not channels_last else 0.0
    leaf, (slopes,) = x.clone().requires_grad_(), layer.blobs
    (top,) = layer.run(leaf)
    expected = torch.autograd.grad(top, [leaf, slopes], diff)
    total = torch.zeros_like(slopes)
    kernels = learning_kernels(layer, Learning((True,), (total,)))
    assert kernels is not None
    forward, backward = kernels
    with torch.no_grad():
        assert torch.equal(forward(x).nan_to_num(), top.nan_to_num())
        for found, wanted in zip((backward(diff), total), expected, strict=True):
            assert torch.equal(found.nan_to_num(), wanted.nan_to_num())


def test_prelu_learns_a_slope_per_channel_or_one_shared_slope(build) -> None:
    bottom = torch.tensor([[[-1.0, 2.0], [-3.0, -4.0], [5.0, -6.0]]])
    layer = build('type: "PReLU"', (1, 3, 2))
    assert layer.blob_shapes == [(3,)]
    assert layer.blobs[0].tolist() == [0.25] * 3
    layer.run(bottom)[0].sum().backward()
    assert layer.blobs[0].grad.tolist() == [-1, -7, -6]

    shared = build('type: "PReLU" prelu_param { channel_shared: true filler { value: 0.5 } }', (1, 3, 2))
    assert shared.blob_shapes == [()]
    shared.run(bottom)[0].sum().backward()
    assert (shared.blobs[0].item(), shared.blobs[0].grad.item()) == (0.5, -14)


def test_clip_without_max_is_refused(build) -> None:
    from netspec.layers import layer_class
    from netspec.proto.schema import LayerParameter

    param = LayerParameter(type="Clip", bottom=["x"], top=["y"])
    param.clip_param.min = 0
    clip = layer_class("Clip")
    assert clip is not None
    with pytest.raises(SpecError, match="clip_param has no max; both min and max are required"):
        clip(param, [(3,)])


# The gradients that Caffe computes from overwritten memory (netspec/run/eager.py): bottom and top are arbitrary.


GRADIENTS = {
    "ReLU": ('type: "ReLU"', lambda b, t: b > 0),
    "ReLU_slope": ('type: "ReLU" relu_param { negative_slope: 0.1 }', lambda b, t: np.where(b > 0, 1, 0.1)),
    "ELU": ('type: "ELU" elu_param { alpha: 2 }', lambda b, t: np.where(b > 0, 1, 2 + t)),
    "Sigmoid": ('type: "Sigmoid"', lambda b, t: t * (1 - t)),
    "TanH": ('type: "TanH"', lambda b, t: 1 - t**2),
    "Power_3": ('type: "Power" power_param { power: 3 scale: 2 shift: 1 }', lambda b, t: 6 * t / (2 * b + 1)),
    "Power_3_without_shift": ('type: "Power" power_param { power: 3 scale: 2 }', lambda b, t: 3 * t / b),
    "Power_2": ('type: "Power" power_param { power: 2 scale: 2 shift: 1 }', lambda b, t: 4 * (2 * b + 1)),
    "Power_1": ('type: "Power" power_param { scale: 2 shift: 1 }', lambda b, t: 0 * b + 2),
    "Power_0": ('type: "Power" power_param { power: 0 }', lambda b, t: 0 * b),
    "Exp": ('type: "Exp" exp_param { base: 2 scale: 3 shift: 1 }', lambda b, t: t * 3 * math.log(2)),
    "Log": ('type: "Log" log_param { base: 2 scale: 3 shift: 5 }', lambda b, t: 3 / math.log(2) / (3 * b + 5)),
    "BNLL": ('type: "BNLL"', lambda b, t: sigmoid(b)),
    "Swish": ('type: "Swish" swish_param { beta: 2 }', lambda b, t: 2 * t + sigmoid(2 * b) * (1 - 2 * t)),
    "Clip": ('type: "Clip" clip_param { min: -0.5 max: 0.75 }', lambda b, t: (b >= -0.5) & (b <= 0.75)),
}


@pytest.mark.parametrize(("text", "expected"), GRADIENTS.values(), ids=GRADIENTS)
def test_caffes_gradient_is_computed_from_the_given_bottom_and_top(build, text: str, expected) -> None:
    bottom = torch.tensor([-1.5, -0.4, 0.25, 0.75, 2.0], dtype=torch.double)
    top = torch.tensor([0.3, -0.2, 0.5, 1.5, -4.0], dtype=torch.double)
    diff = torch.tensor([1.0, 2.0, -3.0, 0.5, 4.0], dtype=torch.double)
    layer = build(text, (5,))
    assert layer.gradient_reads
    found = layer.caffes_gradient(bottom, top, diff).numpy()
    np.testing.assert_allclose(found, diff.numpy() * expected(bottom.numpy(), top.numpy()), rtol=1e-6)
