"""BatchNorm, Scale, Bias, LRN and MVN."""

import numpy as np
import pytest
import torch

from netspec.errors import SpecError
from netspec.proto.schema import TEST, TRAIN

# BatchNorm


def statistics(data: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean and biased variance of each channel, in double."""
    rows = data.double().transpose(0, 1).flatten(1)
    return rows.mean(1), rows.var(1, unbiased=False)


def along_channels(values: torch.Tensor, data: torch.Tensor) -> torch.Tensor:
    return values.reshape(-1, *(1,) * (data.dim() - 2))


def normalized(data: torch.Tensor, eps: float = 1e-5) -> torch.Tensor:
    mean, variance = (along_channels(s, data) for s in statistics(data))
    return ((data.double() - mean) / torch.sqrt(variance + eps)).float()


@pytest.mark.parametrize(
    "shape", [(6, 3), (4, 3, 5), (4, 3, 5, 6), (2, 3, 4, 3, 2)], ids=lambda shape: f"{len(shape)}_axes"
)
def test_batch_norm_normalizes_by_the_batch_in_training(build, shape: tuple) -> None:
    layer = build('type: "BatchNorm" batch_norm_param { eps: 0.01 }', shape, phase=TRAIN)
    data = torch.randn(shape) * 3 + 2
    torch.testing.assert_close(layer.run(data)[0], normalized(data, 0.01), atol=2e-6, rtol=1e-6)
    assert layer.top_shapes == [shape]


def test_batch_norm_of_one_axis_has_one_channel(build) -> None:
    layer, data = build('type: "BatchNorm"', (4,), phase=TRAIN), torch.arange(4.0)
    torch.testing.assert_close(layer.run(data)[0], normalized(data[:, None])[:, 0])
    assert [tuple(blob.shape) for blob in layer.blobs] == [(1,)] * 3
    assert layer.blob(0).tolist() == [1.5]


def test_batch_norm_adds_to_sums_and_divides_them_by_their_weight(build) -> None:
    layer = build('type: "BatchNorm" batch_norm_param { moving_average_fraction: 0.9 }', (4, 3, 5, 5), phase=TRAIN)
    sums = [torch.zeros(3, dtype=torch.double), torch.zeros(3, dtype=torch.double), torch.zeros(1, dtype=torch.double)]
    for batch in (4, 2, 7):  # batches of other sizes: other corrections of the variance
        data = torch.randn(batch, 3, 5, 5) * 2 + 1
        layer.run(data)
        mean, variance = statistics(data)
        count = batch * 25
        for total, addend in zip(sums, (mean, variance * count / (count - 1), 1.0), strict=True):
            total.mul_(0.9).add_(addend)
    for blob, total in zip(layer.blobs, sums, strict=True):
        torch.testing.assert_close(blob.detach(), total.float(), rtol=1e-6, atol=1e-6)

    tester = build('type: "BatchNorm"', (4, 3, 5, 5), phase=TEST)
    tester.load_state_dict(layer.state_dict())
    data = torch.randn(4, 3, 5, 5)
    mean, variance = (along_channels(s / sums[2], data) for s in sums[:2])
    expected = ((data - mean) / torch.sqrt(variance + 1e-5)).float()
    torch.testing.assert_close(tester.run(data)[0], expected, rtol=1e-6, atol=2e-6)
    assert all(torch.equal(a, b) for a, b in zip(layer.blobs, tester.blobs, strict=True))  # testing leaves them alone


def test_batch_norm_without_statistics_divides_by_the_root_of_eps(build) -> None:
    data = torch.randn(2, 3, 4, 4)
    layer = build('type: "BatchNorm" batch_norm_param { eps: 0.04 }', data.shape, phase=TEST)
    torch.testing.assert_close(layer.run(data)[0], data / 0.2)


def test_batch_norm_of_one_value_per_channel_has_variance_zero(build) -> None:
    layer = build('type: "BatchNorm"', (1, 3), phase=TRAIN)
    data = torch.randn(1, 3, requires_grad=True)
    (top,) = layer.run(data)
    assert top.abs().max() < 1e-3
    top.sum().backward()
    assert data.grad is not None
    assert data.grad.abs().max() < 1e-3
    assert torch.equal(layer.blobs[0].detach(), data.detach()[0])
    assert layer.blobs[1].tolist() == [0, 0, 0]  # m / (m - 1) is 1 for m = 1
    assert layer.blobs[2].item() == 1


@pytest.mark.parametrize("phase", [TRAIN, TEST], ids=["TRAIN", "TEST"])
def test_batch_norm_is_accurate_for_means_far_from_zero(build, phase: int) -> None:
    """torch's CPU kernel alone would be off by 1e-2 here, Caffe's sums by 3e-4."""
    layer = build('type: "BatchNorm"', (8, 2, 16, 16), phase=phase, exact="none")
    data = torch.randn(8, 2, 16, 16) + torch.tensor([10000.0, -3.0]).reshape(1, 2, 1, 1)
    mean, variance = statistics(data)
    if phase == TEST:
        for blob, values in zip(layer.blobs, (mean.float(), variance.float(), torch.ones(1)), strict=True):
            blob.data = values
        mean = mean.float().double()
    bottom = data.clone().requires_grad_()
    (top,) = layer.run(bottom)
    expected = (data.double() - along_channels(mean, data)) / torch.sqrt(along_channels(variance, data) + 1e-5)
    torch.testing.assert_close(top, expected.float(), atol=3e-6, rtol=0)
    if phase == TRAIN:
        torch.testing.assert_close(layer.blobs[0].detach(), mean.float(), rtol=1e-6, atol=0)
        torch.testing.assert_close(layer.blobs[1].detach(), (variance * 2048 / 2047).float(), rtol=1e-5, atol=0)
        diff = torch.randn(data.shape)
        top.backward(diff)
        near = build('type: "BatchNorm"', data.shape, phase=TRAIN)
        centred = (data - along_channels(mean.float(), data)).requires_grad_()
        near.run(centred)[0].backward(diff)
        torch.testing.assert_close(bottom.grad, centred.grad, atol=1e-5, rtol=1e-4)


def test_batch_norm_accepts_another_map_size_but_no_other_number_of_channels(build) -> None:
    layer = build('type: "BatchNorm" param { lr_mult: 0 }', (2, 3, 4, 4), phase=TRAIN)
    assert layer.run(torch.randn(5, 3, 2, 2))[0].shape == (5, 3, 2, 2)
    with pytest.raises(SpecError, match=r"found a bottom of shape \(2, 4, 4, 4\), expected 3 channels"):
        layer.run(torch.randn(2, 4, 4, 4))


# Scale and Bias

OPERANDS = [  # axis, num_axes, the operand's shape, the same to broadcast: over a bottom of (2, 3, 4, 5)
    (1, 1, (3,), (1, 3, 1, 1)),
    (0, 2, (2, 3), (2, 3, 1, 1)),
    (1, 2, (3, 4), (1, 3, 4, 1)),
    (2, -1, (4, 5), (1, 1, 4, 5)),
    (0, -1, (2, 3, 4, 5), (2, 3, 4, 5)),
    (-1, 1, (5,), (1, 1, 1, 5)),
    (-3, 1, (3,), (1, 3, 1, 1)),
    (1, 0, (), ()),
]
OPERAND_IDS = [f"axis_{axis}-num_axes_{num_axes}" for axis, num_axes, *_ in OPERANDS]
SHAPE = (2, 3, 4, 5)
SCALE_FILL = 'filler { type: "gaussian" }'


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "num_axes", "shape", "broadcast"), OPERANDS, ids=OPERAND_IDS)
def test_learned_scale_and_bias_are_broadcast_from_axis_over_num_axes(
    build, gradcheck, axis, num_axes, shape, broadcast
) -> None:
    data = torch.randn(SHAPE)
    where = f"axis: {axis} num_axes: {num_axes} {SCALE_FILL}"
    scale = build(f'type: "Scale" scale_param {{ {where} bias_term: true bias_filler {{ type: "gaussian" }} }}', SHAPE)
    factors, bias = scale.blobs
    assert scale.blob_shapes == [shape, shape]
    torch.testing.assert_close(scale.run(data)[0], data * factors.reshape(broadcast) + bias.reshape(broadcast))
    gradcheck(scale, data)

    layer = build(f'type: "Bias" bias_param {{ {where} }}', SHAPE)
    assert layer.blob_shapes == [shape]
    torch.testing.assert_close(layer.run(data)[0], data + layer.blobs[0].reshape(broadcast))
    gradcheck(layer, data)


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "num_axes", "shape", "broadcast"), OPERANDS, ids=OPERAND_IDS)
def test_scale_and_bias_broadcast_a_second_bottom(build, gradcheck, axis, num_axes, shape, broadcast) -> None:
    data, operand = torch.randn(SHAPE), torch.randn(shape)
    scale = build(f'type: "Scale" scale_param {{ axis: {axis} }}', SHAPE, shape)
    assert len(scale.blobs) == 0
    torch.testing.assert_close(scale.run(data, operand)[0], data * operand.reshape(broadcast))
    gradcheck(scale, data, operand)

    bias = build(f'type: "Bias" bias_param {{ axis: {axis} }}', SHAPE, shape)
    torch.testing.assert_close(bias.run(data, operand)[0], data + operand.reshape(broadcast))
    gradcheck(bias, data, operand)


@pytest.mark.parametrize("shape", [(3,), (3, 4)], ids=["one_axis", "two_axes"])
def test_scale_by_a_second_bottom_can_learn_a_bias(build, gradcheck, shape: tuple) -> None:
    text = 'type: "Scale" scale_param { bias_term: true bias_filler { value: 2 } }'
    data, operand = torch.randn(SHAPE), torch.randn(shape)
    layer = build(text, SHAPE, shape)
    assert layer.blob_shapes == [shape]
    expected = data * operand.reshape(*shape, *(1,) * (3 - len(shape))) + 2
    torch.testing.assert_close(layer.run(data, operand)[0], expected)
    gradcheck(layer, data, operand)


def test_scale_is_initialized_to_one_unless_it_has_a_filler_and_bias_to_zero(build) -> None:
    assert build('type: "Scale" scale_param { bias_term: true }', SHAPE).blobs[0].tolist() == [1, 1, 1]
    assert build('type: "Scale" scale_param { bias_term: true }', SHAPE).blobs[1].tolist() == [0, 0, 0]
    assert build('type: "Scale" scale_param { filler { } }', SHAPE).blobs[0].tolist() == [0, 0, 0]  # constant, value 0
    assert build('type: "Bias"', SHAPE).blobs[0].tolist() == [0, 0, 0]


@pytest.mark.parametrize("kind", ["Scale", "Bias"])
def test_scale_and_bias_accept_a_scalar_second_bottom(build, kind: str) -> None:
    data = torch.randn(5)
    top = build(f'type: "{kind}"', (5,), ()).run(data, torch.tensor(3.0))[0]
    torch.testing.assert_close(top, data * 3 if kind == "Scale" else data + 3)


def test_scale_accepts_another_batch_size_but_no_other_number_of_channels(build) -> None:
    layer = build('type: "Scale"', SHAPE)
    assert layer.run(torch.randn(7, 3, 2))[0].shape == (7, 3, 2)
    with pytest.raises(SpecError, match=r"operand of shape \(3,\) does not match"):
        layer.run(torch.randn(2, 4, 4, 5))


# LRN


def plain_lrn(data: np.ndarray, size: int, alpha: float, beta: float, k: float, within: bool) -> np.ndarray:
    reach = size // 2
    result = np.empty_like(data, dtype=np.float64)
    for n, c, y, x in np.ndindex(*data.shape):
        if within:
            near = data[n, c, max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
            base = 1 + alpha / size**2 * np.square(near, dtype=np.float64).sum()
        else:
            near = data[n, max(c - reach, 0) : c + reach + 1, y, x]
            base = k + alpha / size * np.square(near, dtype=np.float64).sum()
        result[n, c, y, x] = data[n, c, y, x] / base**beta
    return result


@pytest.mark.parametrize("region", ["ACROSS_CHANNELS", "WITHIN_CHANNEL"])
@pytest.mark.parametrize("size", [1, 3, 5, 9])
def test_lrn_equals_plain_loops_and_ignores_k_within_a_channel(build, region: str, size: int) -> None:
    settings = f"local_size: {size} alpha: 0.7 beta: 0.6 k: 2.5 norm_region: {region}"
    data = np.random.default_rng(size).standard_normal((2, 6, 4, 5)).astype(np.float32)
    layer = build(f'type: "LRN" lrn_param {{ {settings} }}', data.shape)
    expected = plain_lrn(data, size, 0.7, 0.6, 2.5, region == "WITHIN_CHANNEL")
    np.testing.assert_allclose(layer.run(torch.from_numpy(data))[0], expected, rtol=2e-6)


# MVN


@pytest.mark.parametrize("across", [False, True], ids=["per_channel", "across_channels"])
@pytest.mark.parametrize("variance", [False, True], ids=["mean_only", "normalize_variance"])
def test_mvn_adds_eps_to_the_deviation(build, gradcheck, across: bool, variance: bool) -> None:
    flags = f"across_channels: {str(across).lower()} normalize_variance: {str(variance).lower()}"
    data = torch.randn(2, 3, 4, 5)
    layer = build(f'type: "MVN" mvn_param {{ {flags} eps: 0.3 }}', data.shape)
    axes = (1, 2, 3) if across else (2, 3)
    expected = data - data.mean(axes, keepdim=True)
    if variance:
        expected = expected / (data.var(axes, unbiased=False, keepdim=True).sqrt() + 0.3)
    torch.testing.assert_close(layer.run(data)[0], expected)
    gradcheck(build(f'type: "MVN" mvn_param {{ {flags} }}', data.shape), data)


def test_mvn_gradient_is_caffes_where_eps_counts(build) -> None:
    """(diff - mean(diff) - mean(diff top) top) / (deviation + eps): autograd would scale the last term."""
    data = torch.randn(1, 1, 3, 4, dtype=torch.double, requires_grad=True)
    (top,) = build('type: "MVN" mvn_param { eps: 0.5 }', data.shape).run(data)
    diff = torch.randn(top.shape, dtype=torch.double)
    top.backward(diff)
    t, deviation = top.detach(), float(data.detach().std(unbiased=False)) + 0.5
    torch.testing.assert_close(data.grad, (diff - diff.mean() - (diff * t).mean() * t) / deviation)


def test_mvn_of_a_constant_map_is_zero_with_a_finite_gradient(build) -> None:
    data = torch.full((1, 1, 2, 2), 3.0, requires_grad=True)
    (top,) = build('type: "MVN" mvn_param { eps: 0.5 }', data.shape).run(data)
    assert top.count_nonzero() == 0
    top.backward(torch.tensor([[[[1.0, 2.0], [3.0, 6.0]]]]))
    assert data.grad is not None
    assert data.grad.flatten().tolist() == [-4, -2, 0, 6]


def test_mvn_appends_axes_of_size_one_up_to_four_axes(build) -> None:
    layer = build('type: "MVN" mvn_param { across_channels: true }', (2, 6))
    data = torch.randn(2, 6)
    (top,) = layer.run(data)
    assert layer.top_shapes == [(2, 6, 1, 1)]
    rows = (data - data.mean(1, keepdim=True)) / data.std(1, unbiased=False, keepdim=True)
    torch.testing.assert_close(top, rows.reshape(2, 6, 1, 1))
