"""Pooling and SPP compared with plain versions of Caffe's loops at random settings, and in corner cases."""

import math

import numpy as np
import pytest
import torch

from netspec.fast.kernels import Inference
from netspec.fast.table import inference_kernel
from netspec.proto.schema import TRAIN

LOWEST = np.finfo(np.float32).min  # -FLT_MAX


def window_count(size: int, kernel: int, stride: int, pad: int, padded: bool, floor: bool) -> int:
    room = (size + 2 * pad - kernel) / stride
    count = (math.floor(room) if floor else math.ceil(room)) + 1
    return count - 1 if padded and (count - 1) * stride >= size + pad else count


def plain_pool(data: np.ndarray, kernel, stride, pad, floor: bool, average: bool, top_diff=None):
    """Return top, mask (of MAX) and the bottom's gradient as Caffe's loops do; ``top_diff`` is 1 by default."""
    size = data.shape[2:]
    counts = [window_count(size[i], kernel[i], stride[i], pad[i], any(pad), floor) for i in range(2)]
    top = np.full((*data.shape[:2], *counts), 0 if average else LOWEST, data.dtype)
    mask = np.full(top.shape, -1)
    diff = np.zeros_like(data)
    for n, c, y, x in np.ndindex(*top.shape):
        starts = [y * stride[0] - pad[0], x * stride[1] - pad[1]]
        ends = [min(starts[i] + kernel[i], size[i] + pad[i]) for i in range(2)]
        area = (ends[0] - starts[0]) * (ends[1] - starts[1])
        rows, columns = (range(max(starts[i], 0), min(ends[i], size[i])) for i in range(2))
        for h in rows:
            for w in columns:
                value = data[n, c, h, w]
                if average:
                    top[n, c, y, x] += value
                    diff[n, c, h, w] += (1 if top_diff is None else top_diff[n, c, y, x]) / area
                elif value > top[n, c, y, x]:
                    top[n, c, y, x], mask[n, c, y, x] = value, h * size[1] + w
        if average:
            top[n, c, y, x] = np.float32(top[n, c, y, x]) / np.float32(area) if area else np.nan
        elif mask[n, c, y, x] >= 0:
            h, w = divmod(mask[n, c, y, x], size[1])
            diff[n, c, h, w] += 1 if top_diff is None else top_diff[n, c, y, x]
    return top, mask, diff


def random_settings(random: np.random.Generator):
    """Yield settings that Caffe accepts: kernel, stride, pad, floor, size of the map."""
    for _ in range(150):
        kernel, stride = (tuple(map(int, random.integers(1, 6, 2))) for _ in range(2))
        pad = tuple(int(random.integers(0, k)) for k in kernel) if random.random() < 0.5 else (0, 0)
        size = tuple(map(int, random.integers(1, 12, 2)))
        floor = bool(random.random() < 0.3)
        counts = [window_count(size[i], kernel[i], stride[i], pad[i], any(pad), floor) for i in range(2)]
        if min(counts) >= 1:
            yield kernel, stride, pad, floor, size


def pooling_text(method: str, kernel, stride, pad, floor: bool) -> str:
    names = ("kernel_h", "kernel_w", "stride_h", "stride_w", "pad_h", "pad_w")
    fields = " ".join(f"{name}: {value}" for name, value in zip(names, (*kernel, *stride, *pad), strict=True))
    return f'type: "Pooling" pooling_param {{ pool: {method} {fields} {"round_mode: FLOOR" if floor else ""} }}'


@pytest.mark.slow
@pytest.mark.parametrize("method", ["MAX", "AVE"])
def test_pooling_agrees_with_plain_loops_at_random_settings(build, method: str) -> None:
    random = np.random.default_rng(7)
    wide_pads = empty_windows = cases = 0
    for kernel, stride, pad, floor, size in random_settings(random):
        # few different values, so that maxima tie
        data = random.integers(-3, 4, (2, 2, *size)).astype(np.float32)
        layer = build(pooling_text(method, kernel, stride, pad, floor), data.shape, tops=1 + (method == "MAX"))
        order = torch.channels_last if cases % 2 else torch.contiguous_format  # torch has a kernel for each
        bottom = torch.from_numpy(data).to(memory_format=order).requires_grad_()
        tops = layer.run(bottom)
        top_diff = random.standard_normal(tops[0].shape).astype(np.float32)
        expected, mask, diff = plain_pool(data, kernel, stride, pad, floor, method == "AVE", top_diff)
        what = f"{kernel=} {stride=} {pad=} {floor=} {size=}"
        assert layer.top_shapes[0] == expected.shape == tuple(tops[0].shape), what
        np.testing.assert_allclose(tops[0].detach(), expected, rtol=1e-6, atol=1e-7, err_msg=what)
        if method == "MAX":
            np.testing.assert_array_equal(tops[1], mask, err_msg=what)
        tops[0].backward(torch.from_numpy(top_diff))
        assert bottom.grad is not None, what
        np.testing.assert_allclose(bottom.grad, diff, atol=1e-5, err_msg=what)
        cases += 1
        wide_pads += any(2 * p > k for p, k in zip(pad, kernel, strict=True))
        empty_windows += not any(pad) and any(
            (n - 1) * s >= z for n, s, z in zip(expected.shape[2:], stride, size, strict=True)
        )
    assert cases > 80
    assert wide_pads > 10
    assert empty_windows > 10


@pytest.mark.slow
@pytest.mark.parametrize("value", [np.nan, -np.inf, np.inf])
def test_max_pooling_of_nan_and_infinity_agrees_with_plain_loops(build, value: float) -> None:
    random = np.random.default_rng(3)
    for kernel, stride, pad, floor, size in random_settings(random):
        data = random.standard_normal((2, 2, *size)).astype(np.float32)
        data[random.random(data.shape) < 0.4] = value
        layer = build(pooling_text("MAX", kernel, stride, pad, floor), data.shape, tops=2)
        bottom = torch.from_numpy(data).requires_grad_()
        top, mask = layer.run(bottom)
        expected, expected_mask, diff = plain_pool(data, kernel, stride, pad, floor, average=False)
        np.testing.assert_array_equal(top.detach(), expected)
        np.testing.assert_array_equal(mask, expected_mask)
        top.backward(torch.ones_like(top))
        np.testing.assert_array_equal(bottom.grad, diff)


@pytest.mark.parametrize("method", ["MAX", "AVE"])
def test_global_pooling_covers_maps_of_any_size(build, method: str) -> None:
    layer = build(f'type: "Pooling" pooling_param {{ pool: {method} global_pooling: true }}', (2, 3, 5, 7))
    for shape in ((2, 3, 5, 7), (4, 3, 2, 9)):
        data = torch.randn(shape)
        (top,) = layer.run(data)
        assert layer.top_shapes == [(*shape[:2], 1, 1)]
        torch.testing.assert_close(top[..., 0, 0], data.amax((2, 3)) if method == "MAX" else data.mean((2, 3)))


@pytest.mark.parametrize(
    "memory_format", [torch.contiguous_format, torch.channels_last], ids=["contiguous", "channels_last"]
)
@pytest.mark.parametrize("kernel", [2, 3])
def test_inference_kernel_pools_large_maps_of_both_memory_formats(build, kernel: int, memory_format) -> None:
    data = torch.randn(2, 19, 61, 62)
    data[0, 0, :4, :4] = torch.nan  # which never wins
    layer = build(pooling_text("MAX", (kernel, kernel), (2, 2), (0, 0), False), data.shape)
    run = inference_kernel(layer, Inference())
    assert run is not None
    assert torch.equal(run(data.contiguous(memory_format=memory_format)), layer.run(data)[0])


def test_stochastic_pooling_draws_pixels_in_proportion_to_their_value(build) -> None:
    layer = build(
        'type: "Pooling" pooling_param { pool: STOCHASTIC kernel_size: 2 stride: 2 }', (10000, 4, 2, 2), phase=TRAIN
    )
    bottom = torch.tensor([1.0, 0.0, 3.0, 6.0]).reshape(1, 1, 2, 2).repeat(10000, 4, 1, 1).requires_grad_()
    (top,) = layer.run(bottom)
    for value in (1.0, 3.0, 6.0):
        share = float((top == value).float().mean())
        assert share == pytest.approx(value / 10, abs=6 * 0.5 / math.sqrt(40000))
    assert not (top == 0).any()
    top.sum().backward()
    assert bottom.grad is not None
    assert torch.equal((bottom.grad * bottom.detach()).sum((2, 3)), top.detach()[..., 0, 0])  # 1 for the pixel drawn
    assert torch.equal(bottom.grad.sum((2, 3)), torch.ones(10000, 4))


def test_stochastic_pooling_of_a_clipped_window_draws_inside_the_map(build) -> None:
    text = 'type: "Pooling" pooling_param { pool: STOCHASTIC kernel_size: 3 stride: 2 }'
    data = torch.rand(50, 3, 6, 6) + 1
    layer = build(text, data.shape, phase=TRAIN, seed=5)
    (top,) = layer.run(data)
    assert layer.top_shapes == [(50, 3, 3, 3)] == [tuple(top.shape)]
    corner = data[:, :, 4:, 4:].flatten(2)
    assert (top[:, :, 2, 2].unsqueeze(2) == corner).any(2).all()
    assert not torch.equal(top, layer.run(data)[0])
    assert torch.equal(top, build(text, data.shape, phase=TRAIN, seed=5).run(data)[0])
    assert build(text, data.shape, phase=TRAIN).run(torch.zeros(data.shape))[0].count_nonzero() == 0


def test_stochastic_pooling_in_the_test_phase_weights_each_pixel_by_itself(build) -> None:
    layer = build('type: "Pooling" pooling_param { pool: STOCHASTIC kernel_size: 3 stride: 2 }', (1, 1, 4, 4))
    data = torch.rand(1, 1, 4, 4)
    (top,) = layer.run(data)
    for y, x in np.ndindex(2, 2):
        window = data[0, 0, 2 * y : 2 * y + 3, 2 * x : 2 * x + 3]
        assert float(top[0, 0, y, x]) == pytest.approx(float(window.square().sum() / window.sum()))
    assert layer.run(torch.zeros(1, 1, 4, 4))[0].count_nonzero() == 0  # 0 / FLT_MIN


@pytest.mark.slow
@pytest.mark.parametrize("method", ["MAX", "AVE"])
def test_spp_concatenates_its_levels(build, gradcheck, method: str) -> None:
    layer = build(f'type: "SPP" spp_param {{ pyramid_height: 3 pool: {method} }}', (2, 3, 9, 12))
    for size in ((9, 12), (11, 6), (12, 15)):
        data = torch.rand(2, 3, *size)
        (top,) = layer.run(data)
        assert layer.top_shapes == [(2, 3 * 21)]
        expected = []
        for bins in (1, 2, 4):
            kernel = [math.ceil(n / bins) for n in size]
            pad = [math.ceil((k * bins - n) / 2) for k, n in zip(kernel, size, strict=True)]
            level, _, _ = plain_pool(data.numpy(), kernel, kernel, pad, floor=False, average=method == "AVE")
            assert level.shape[2:] == (bins, bins)
            expected.append(level.reshape(2, -1))
        np.testing.assert_allclose(top, np.concatenate(expected, axis=1), rtol=1e-6)
    gradcheck(layer, torch.rand(2, 3, 9, 12))


def test_spp_of_one_level_keeps_four_axes(build) -> None:
    layer = build('type: "SPP" spp_param { pyramid_height: 1 }', (2, 3, 5, 7))
    data = torch.randn(2, 3, 5, 7)
    assert layer.top_shapes == [(2, 3, 1, 1)]
    assert torch.equal(layer.run(data)[0], data.amax((2, 3), keepdim=True))
