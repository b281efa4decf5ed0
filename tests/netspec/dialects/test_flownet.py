"""FlowNet's layers, whose fork computes them on GPUs only: beside plain loops over pixels."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from netspec.layers import Layer

Build = Callable[..., Layer]
Gradcheck = Callable[..., None]
CORRELATION = "type: 'Correlation' correlation_param {{ {} }}"
RESAMPLE = "type: 'Resample' resample_param {{ height: {} width: {} {} }}"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "pad", "kernel", "most", "stride", "step"),
    [
        ("pad: 2 kernel_size: 1 max_displacement: 2", 2, 1, 2, 1, 1),
        ("pad: 4 kernel_size: 3 max_displacement: 4 stride_1: 2 stride_2: 2", 4, 3, 4, 2, 2),
        ("kernel_size: 1 max_displacement: 2 stride_2: 2 correlation_type: SUBTRACT", 0, 1, 2, 1, 2),
    ],
)
def test_patches_are_compared(
    build: Build, gradcheck: Gradcheck, settings: str, pad: int, kernel: int, most: int, stride: int, step: int
) -> None:
    bottoms = torch.randn(2, 3, 7, 9), torch.randn(2, 3, 7, 9)
    layer = build("flownet", CORRELATION.format(settings), *(b.shape for b in bottoms))
    top = layer.run(*bottoms)[0].numpy()
    a, b = (np.pad(x.numpy(), [(0, 0), (0, 0), (pad, pad), (pad, pad)]) for x in bottoms)
    moves = [m * step for m in range(-(most // step), most // step + 1)]
    height, width = (math.ceil((side + 2 * pad - 2 * (most + kernel // 2)) / stride) for side in (7, 9))
    assert top.shape == (2, len(moves) ** 2, height, width)
    for c, (dy, dx) in enumerate((dy, dx) for dy in moves for dx in moves):
        for i, j in np.ndindex(height, width):
            y, x = most + i * stride, most + j * stride
            one = a[:, :, y : y + kernel, x : x + kernel]
            other = b[:, :, y + dy : y + dy + kernel, x + dx : x + dx + kernel]
            each = np.abs(one - other) if "SUBTRACT" in settings else one * other
            np.testing.assert_allclose(top[:, c, i, j], each.mean(axis=(1, 2, 3)), rtol=1e-4, atol=1e-6)
    small = [bottom[:1, :2, :5, :6] for bottom in bottoms]
    gradcheck(build("flownet", CORRELATION.format(settings), *(b.shape for b in small)), *small)


def weight(kind: str, x: float) -> float:
    x = abs(x)
    if kind == "LINEAR":
        return max(0.0, 1 - x)
    near, far = 1.5 * x**3 - 2.5 * x**2 + 1, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    return near if x <= 1 else far if x < 2 else 0.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["LINEAR", "CUBIC", "NEAREST"])
@pytest.mark.parametrize(("height", "width", "antialias"), [(13, 17, True), (3, 4, True), (3, 4, False), (4, 15, True)])
def test_maps_are_resampled(build: Build, kind: str, height: int, width: int, antialias: bool) -> None:
    data = torch.randn(2, 3, 7, 9)
    text = RESAMPLE.format(height, width, f"type: {kind} antialias: {str(antialias).lower()}")
    top = build("flownet", text, data.shape).run(data)[0].numpy()
    fy, fx = 7 / height, 9 / width
    smooth = antialias and max(fx, fy) > 1
    for i, j in np.ndindex(height, width):
        y, x = i * fy + fx / 2 - 0.5, j * fx + fy / 2 - 0.5
        if kind == "NEAREST":
            near = data[:, :, min(6, max(0, math.floor(y + 0.5))), min(8, max(0, math.floor(x + 0.5)))]
            assert np.array_equal(top[:, :, i, j], near)
            continue
        total, weights = np.zeros((2, 3)), 0.0
        for k, m in np.ndindex(7, 9):
            w = weight(kind, (y - k) / (fy if smooth else 1)) * weight(kind, (x - m) / (fx if smooth else 1))
            total, weights = total + w * data[:, :, k, m].numpy(), weights + w
        np.testing.assert_allclose(top[:, :, i, j], total / (weights or 1), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_an_image_follows_a_flow(build: Build, gradcheck: Gradcheck) -> None:
    image, flow = torch.randn(2, 3, 5, 6), 3 * torch.randn(2, 2, 5, 6)
    layer = build("flownet", "type: 'FlowWarp' flow_warp_param { fill_value: NOT_A_NUMBER }", image.shape, flow.shape)
    top = layer.run(image, flow)[0]
    for n, i, j in np.ndindex(2, 5, 6):
        x, y = j + float(flow[n, 0, i, j]), i + float(flow[n, 1, i, j])
        if not (0 <= x < 6 and 0 <= y < 5):
            assert top[n, :, i, j].isnan().all()
            continue
        left, up = int(x), int(y)
        right, low = min(left + 1, 5), min(up + 1, 4)
        a, b, expected = x - left, y - up, 0
        for wy, k in ((1 - b, up), (b, low)):
            for wx, m in ((1 - a, left), (a, right)):
                expected = expected + wy * wx * image[n, :, k, m]
        torch.testing.assert_close(top[n, :, i, j], expected, rtol=1e-4, atol=1e-5)
    zeros = build("flownet", "type: 'FlowWarp'", image.shape, flow.shape)
    assert torch.equal(zeros.run(image, flow)[0], top.nan_to_num(0))
    gradcheck(zeros, image, flow)


def test_the_length_of_the_channels(build: Build, gradcheck: Gradcheck) -> None:
    maps = torch.randn(2, 3, 4, 5)
    layer = build("flownet", "type: 'ChannelNorm'", maps.shape)
    torch.testing.assert_close(layer.run(maps)[0][:, 0], maps.square().sum(1).sqrt())
    gradcheck(layer, maps)
