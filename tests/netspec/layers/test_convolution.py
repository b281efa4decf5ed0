"""Convolution, Deconvolution, Im2col and Crop compared with plain loops at random settings; corner cases; errors."""

import math

import numpy as np
import pytest
import torch

from netspec.errors import SpecError
from netspec.exact.products import Filter

FILL = 'weight_filler { type: "gaussian" } bias_filler { type: "gaussian" }'


def positions(bottom: tuple, kernel: tuple, stride: tuple, pad: tuple, dilation: tuple) -> tuple[int, ...]:
    """Return how often a filter fits along each axis; the quotient rounds toward zero, as in C++."""
    sizes = zip(bottom, kernel, stride, pad, dilation, strict=True)
    return tuple(math.trunc((n + 2 * p - d * (k - 1) - 1) / s) + 1 for n, k, s, p, d in sizes)


def taps(bottom: tuple, top: tuple, kernel: tuple, stride: tuple, pad: tuple, dilation: tuple):
    """Yield (top position, filter position, bottom position) of each pixel that a sliding filter meets."""
    for y in np.ndindex(*top):
        for k in np.ndindex(*kernel):
            x = tuple(i * s - p + j * d for i, s, p, j, d in zip(y, stride, pad, k, dilation, strict=True))
            if all(0 <= i < n for i, n in zip(x, bottom, strict=True)):
                yield y, k, x


def convolve(data: np.ndarray, weight: np.ndarray, bias: np.ndarray, group: int, *geometry: tuple) -> np.ndarray:
    top = positions(data.shape[2:], weight.shape[2:], *geometry)
    result = np.zeros((data.shape[0], weight.shape[0], *top)) + bias.reshape(1, -1, *(1,) * len(top))
    for y, k, x in taps(data.shape[2:], top, weight.shape[2:], *geometry):
        for g in range(group):
            inside = slice(g * weight.shape[1], (g + 1) * weight.shape[1])
            out = slice(g * weight.shape[0] // group, (g + 1) * weight.shape[0] // group)
            result[(slice(None), out, *y)] += data[(slice(None), inside, *x)] @ weight[(out, slice(None), *k)].T
    return result


def deconvolve(data: np.ndarray, weight: np.ndarray, bias: np.ndarray, group: int, *geometry: tuple) -> np.ndarray:
    stride, pad, dilation = geometry
    sizes = zip(data.shape[2:], weight.shape[2:], stride, pad, dilation, strict=True)
    top = tuple(s * (n - 1) + d * (k - 1) + 1 - 2 * p for n, k, s, p, d in sizes)
    result = np.zeros((data.shape[0], weight.shape[1] * group, *top)) + bias.reshape(1, -1, *(1,) * len(top))
    for x, k, y in taps(top, data.shape[2:], weight.shape[2:], *geometry):  # the same pairs, walked the other way
        for g in range(group):
            inside = slice(g * weight.shape[0] // group, (g + 1) * weight.shape[0] // group)
            out = slice(g * weight.shape[1], (g + 1) * weight.shape[1])
            result[(slice(None), out, *y)] += data[(slice(None), inside, *x)] @ weight[(inside, slice(None), *k)]
    return result


def repeated(name: str, values: tuple) -> str:
    return " ".join(f"{name}: {v}" for v in values)


def geometry_text(kernel: tuple, stride: tuple, pad: tuple, dilation: tuple) -> str:
    names = ("kernel_size", "stride", "pad", "dilation")
    return " ".join(map(repeated, names, (kernel, stride, pad, dilation)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["Convolution", "Deconvolution"])
@pytest.mark.parametrize("axes", [1, 2, 3])
def test_convolution_and_deconvolution_agree_with_plain_loops_at_random_settings(build, kind: str, axes: int) -> None:
    random = np.random.default_rng(axes)
    for _ in range(12):
        group = int(random.integers(1, 4))
        channels, outputs = (int(group * random.integers(1, 3)) for _ in range(2))
        kernel, stride, dilation = (tuple(map(int, random.integers(1, 4, axes))) for _ in range(3))
        pad = tuple(int(random.integers(0, k)) for k in kernel)
        data = random.standard_normal((2, channels, *map(int, random.integers(4, 8, axes)))).astype(np.float32)
        if kind == "Convolution" and min(positions(data.shape[2:], kernel, stride, pad, dilation)) < 1:
            continue
        text = f"{geometry_text(kernel, stride, pad, dilation)} num_output: {outputs} group: {group} {FILL}"
        layer = build(f'type: "{kind}" convolution_param {{ {text} }}', data.shape)
        weight, bias = (blob.detach().numpy() for blob in layer.blobs)
        oracle = convolve if kind == "Convolution" else deconvolve
        expected = oracle(data, weight, bias, group, stride, pad, dilation)
        (top,) = layer.run(torch.from_numpy(data))
        assert layer.top_shapes == [expected.shape] == [top.shape], text
        np.testing.assert_allclose(top.detach(), expected, atol=2e-5, err_msg=text)
        assert layer.multiply_adds() == len(data) * np.prod(weight.shape) * np.prod(
            expected.shape[2:] if kind == "Convolution" else data.shape[2:]
        )


@pytest.mark.parametrize("size", [40, 250])
def test_results_agree_for_every_choice_of_exact(build, size: int) -> None:
    text = f"num_output: 3 kernel_h: 3 kernel_w: 5 stride: 2 pad: 1 dilation: 2 {FILL}"
    data = torch.randn(2, 4, size, size, requires_grad=True)
    found = []
    for exact in ("none", "small", "all"):  # the larger size is beyond what is small
        layer = build(f'type: "Convolution" convolution_param {{ {text} }}', (2, 4, size, size), exact=exact)
        (top,) = layer.run(data)
        found.append([top, *torch.autograd.grad(top.square().sum(), [data, *layer.blobs])])
    for torchs, *others in zip(*found, strict=True):
        for other in others:
            torch.testing.assert_close(torchs, other, rtol=1e-4, atol=1e-4 * float(torchs.detach().abs().max()))


WRONG_IN_ONEDNN = {  # filters that fit into the padding crash oneDNN; maps of one channel give wrong numbers
    "in_padding": ((5, 2, 12, 1), "kernel_size: 1 stride_h: 1 stride_w: 2 pad_h: 2 pad_w: 1"),
    "in_padding_grouped": (
        (2, 64, 12, 1),
        "group: 16 kernel_h: 3 kernel_w: 1 dilation: 2 stride: 2 pad_h: 0 pad_w: 1",
    ),
    "in_padding_depthwise": ((5, 8, 12, 1), "group: 8 kernel_size: 1 stride: 2 pad: 1"),
    "one_channel": ((5, 1, 12, 1), "kernel_size: 2 stride_h: 1 stride_w: 3 pad_h: 0 pad_w: 1"),
}


@pytest.mark.parametrize(("shape", "text"), WRONG_IN_ONEDNN.values(), ids=WRONG_IN_ONEDNN)
@pytest.mark.parametrize("in_place", [False, True], ids=["new_gradients", "accumulate_in_place"])
def test_calls_with_wrong_results_in_onednn_are_avoided(
    build, shape: tuple[int, ...], text: str, in_place: bool
) -> None:
    layer = build(
        f'type: "Convolution" convolution_param {{ num_output: 16 {text} {FILL} }}',
        shape,
        exact="none",
        accumulate_in_place=in_place,
    )
    sliding = Filter(layer.kernel, layer.stride, layer.pad, layer.dilation)
    assert sliding.reads_padding_alone or shape[1] == 1
    maps = torch.empty_strided(shape, torch.empty(shape).to(memory_format=torch.channels_last).stride())
    maps.normal_().requires_grad_()
    (top,) = layer.run(maps)
    top.sin().sum().backward()
    with torch.no_grad():
        (silent,) = layer.run(maps)
    found = [top, silent, maps.grad, *(blob.grad for blob in layer.blobs)]
    exactly = layer.double()
    twin = maps.detach().double().contiguous().requires_grad_()
    for blob in exactly.blobs:
        blob.grad = None
    (expected,) = exactly.run(twin)
    expected.sin().sum().backward()
    for mine, theirs in zip(found, [expected, expected, twin.grad, *(b.grad for b in exactly.blobs)], strict=True):
        torch.testing.assert_close(mine.double(), theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", ["Convolution", "Deconvolution"])
def test_several_bottoms_share_the_filters_and_their_gradients_are_added_in_order(build, kind: str) -> None:
    text = f'type: "{kind}" convolution_param {{ num_output: 4 kernel_size: 3 {FILL} }}'
    caffes = {"exact": "all", "accumulate_in_place": True}
    layer = build(text, *[(3, 3, 6, 6)] * 3, tops=3, **caffes)
    alone = build(text, (3, 3, 6, 6), **caffes)
    bottoms = [torch.randn(3, 3, 6, 6) for _ in range(3)]
    tops = layer.run(*bottoms)
    diffs = [torch.randn_like(top) for top in tops]
    torch.autograd.backward(tops, diffs)
    for bottom, top, diff in zip(bottoms, tops, diffs, strict=True):
        (expected,) = alone.run(bottom)
        assert torch.equal(top, expected)
        expected.backward(diff)
    for together, one_by_one in zip(layer.blobs, alone.blobs, strict=True):
        assert torch.equal(together.grad, one_by_one.grad)


@pytest.mark.parametrize("size", [5, 50])
def test_gradients_added_at_once_are_autograds(build, size: int) -> None:
    """With few pixels and many filters, the product runs on a copy in another layout; else the bottom is kept."""
    text = f'type: "Convolution" convolution_param {{ num_output: 40 kernel_size: 3 {FILL} }}'
    layer = build(text, (2, 32, size, size), exact="none", accumulate_in_place=True)
    maps = torch.randn(2, 32, size, size).contiguous(memory_format=torch.channels_last).requires_grad_()
    kept: list[int] = []
    with torch.autograd.graph.saved_tensors_hooks(lambda saved: kept.append(saved.data_ptr()) or saved, lambda x: x):
        layer.run(maps)
    assert (maps.data_ptr() in kept) == (size == 50)
    layer.run(maps)[0].sin().sum().backward()
    weight, bias = layer.blobs
    expected = torch.autograd.grad(torch.conv2d(maps, weight, bias).sin().sum(), (maps, weight, bias))
    for mine, theirs in zip((maps.grad, weight.grad, bias.grad), expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("order", [torch.contiguous_format, torch.channels_last], ids=["contiguous", "channels_last"])
@pytest.mark.parametrize("size", [5, 50])
def test_bottom_gradients_have_the_memory_format_of_the_bottom(build, size: int, order: torch.memory_format) -> None:
    """With another format, torch's kernels of earlier layers take 10 to 20 times as long."""
    convolution = f'type: "Convolution" convolution_param {{ num_output: 40 kernel_size: 3 {FILL} }}'
    pooling = 'type: "Pooling" pooling_param { pool: MAX kernel_size: 2 stride: 2 }'
    for text, options in ((convolution, {"exact": "none", "accumulate_in_place": True}), (pooling, {})):
        layer = build(text, (2, 32, size, size), **options)
        maps = torch.randn(2, 32, size, size).contiguous(memory_format=order).requires_grad_()
        seen: list[torch.Tensor] = []
        between = maps * 1
        between.register_hook(seen.append)
        layer.run(between)[0].sin().sum().backward()
        assert seen[0].is_contiguous(memory_format=order), text


def test_axis_selects_the_channels_and_earlier_axes_count_as_images(build) -> None:
    text = 'type: "Convolution" convolution_param { num_output: 2 kernel_size: 3 axis: %d ' + FILL + " }"
    data = torch.randn(2, 5, 3, 6, 7)
    layer = build(text % -3, data.shape)
    assert layer.blob_shapes == [(2, 3, 3, 3), (2,)]
    (top,) = layer.run(data)
    assert layer.top_shapes == [(2, 5, 2, 4, 5)]
    torch.testing.assert_close(top[1, 4], torch.nn.functional.conv2d(data[1, 4], *layer.blobs))
    one_image = build(text % 0, (3, 6, 7))
    torch.testing.assert_close(one_image.run(data[0, 0])[0], torch.nn.functional.conv2d(data[0, 0], *one_image.blobs))


@pytest.mark.parametrize("kind", ["Convolution", "Deconvolution"])
def test_a_map_without_spatial_axes_is_a_single_pixel(build, kind: str) -> None:
    layer = build(f'type: "{kind}" convolution_param {{ num_output: 5 kernel_size: 3 {FILL} }}', (4, 3))
    weight = layer.blobs[0] if kind == "Convolution" else layer.blobs[0].t()
    data = torch.randn(4, 3)
    torch.testing.assert_close(layer.run(data)[0], torch.nn.functional.linear(data, weight, layer.blobs[1]))


def test_a_filter_too_long_by_less_than_its_stride_fits_once_over_zeros(build) -> None:
    """C++ rounds (4 + 0 - 5) / 2 to 0, so Caffe places one filter of 5 on 4 pixels."""
    text = f"convolution_param {{ num_output: 1 kernel_size: 5 stride: 2 {FILL} }}"
    data = torch.randn(1, 1, 4, 6)
    layer = build(f'type: "Convolution" {text}', data.shape)
    assert layer.top_shapes == [(1, 1, 1, 1)]
    expected = (data[..., :5] * layer.blobs[0][..., :4, :]).sum() + layer.blobs[1]
    torch.testing.assert_close(layer.run(data)[0].flatten(), expected)
    columns = build('type: "Im2col" convolution_param { kernel_size: 5 stride: 2 }', data.shape).run(data)[0]
    assert columns.flatten()[:20].tolist() == data[..., :5].flatten().tolist()
    assert columns.flatten()[20:].tolist() == [0] * 5


def test_the_batch_or_map_size_can_change(build) -> None:
    layer = build(f'type: "Convolution" convolution_param {{ num_output: 4 kernel_size: 3 {FILL} }}', (2, 3, 6, 6))
    for shape in ((5, 3, 6, 6), (1, 3, 9, 4), (0, 3, 6, 6)):
        (top,) = layer.run(torch.randn(shape))
        assert layer.top_shapes == [tuple(top.shape)] == [(shape[0], 4, shape[2] - 2, shape[3] - 2)]
    with pytest.raises(SpecError, match=r"^bottom: bottom of shape \(2, 4, 6, 6\) does not fit the filters"):
        layer.run(torch.randn(2, 4, 6, 6))


@pytest.mark.slow
@pytest.mark.parametrize("axes", [1, 2, 3, 4])
def test_im2col_agrees_with_plain_loops_at_random_settings(build, axes: int) -> None:
    random = np.random.default_rng(axes)
    for _ in range(6):
        kernel, stride, dilation = (tuple(map(int, random.integers(1, 3, axes))) for _ in range(3))
        pad = tuple(map(int, random.integers(0, 2, axes)))
        data = random.standard_normal((2, 3, *map(int, random.integers(3, 6, axes)))).astype(np.float32)
        top_size = positions(data.shape[2:], kernel, stride, pad, dilation)
        expected = np.zeros((2, 3, *kernel, *top_size), np.float32)
        for y, k, x in taps(data.shape[2:], top_size, kernel, stride, pad, dilation):
            expected[(slice(None), slice(None), *k, *y)] = data[(slice(None), slice(None), *x)]
        expected = expected.reshape(2, -1, *top_size)
        text = geometry_text(kernel, stride, pad, dilation)
        layer = build(f'type: "Im2col" convolution_param {{ {text} }}', data.shape)
        assert layer.top_shapes == [expected.shape]
        np.testing.assert_array_equal(layer.run(torch.from_numpy(data))[0], expected, err_msg=text)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "window"),
    [
        ("", np.s_[:, :, 0:5, 0:6]),  # axis 2 is the default, offset 0
        ("offset: 2", np.s_[:, :, 2:7, 2:8]),
        ("offset: 3 offset: 1", np.s_[:, :, 3:8, 1:7]),
        ("axis: -1 offset: 3", np.s_[:, :, :, 3:9]),
        ("axis: 1 offset: 1 offset: 0 offset: 2", np.s_[:, 1:3, 0:5, 2:8]),
    ],
    ids=["default", "one_offset", "offset_per_axis", "last_axis", "axis_1"],
)
def test_crop_crops_axis_and_all_later_axes(build, gradcheck, settings: str, window: tuple) -> None:
    data, wanted = torch.randn(2, 3, 8, 9), torch.randn(2, 2, 5, 6)
    layer = build(f'type: "Crop" crop_param {{ {settings} }}', data.shape, wanted.shape)
    assert torch.equal(layer.run(data, wanted)[0], data[window])
    gradcheck(layer, data, wanted)
