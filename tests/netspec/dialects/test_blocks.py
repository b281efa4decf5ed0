"""The building blocks of many forks, each beside plain loops."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch

from netspec.dialects import use_dialect
from netspec.errors import SpecError
from netspec.graph.options import BuildOptions
from netspec.layers import Layer, layer_class, layer_types
from netspec.net.build import build_net
from netspec.proto.schema import TRAIN
from netspec.proto.text import parse_net_text

Build = Callable[..., Layer]
Gradcheck = Callable[..., None]


def numbers(*shape: int) -> torch.Tensor:
    return torch.randn(shape)


def run(layer: Layer, *bottoms: torch.Tensor) -> np.ndarray:
    (top,) = layer.run(*bottoms)
    assert [tuple(top.shape)] == layer.top_shapes
    return top.detach().numpy()


@pytest.mark.slow
@pytest.mark.parametrize("axes", [2, 4])
def test_axpy(build: Build, gradcheck: Gradcheck, axes: int) -> None:
    a, x, y = numbers(2, 3, 1, 1)[(...,) if axes == 4 else (..., 0, 0)], numbers(2, 3, 4, 5), numbers(2, 3, 4, 5)
    layer = build("blocks", 'type: "Axpy"', a.shape, x.shape, y.shape)
    expected = np.empty(x.shape, np.float32)
    for n in range(2):
        for c in range(3):
            expected[n, c] = a.reshape(2, 3)[n, c] * x[n, c] + y[n, c]
    np.testing.assert_allclose(run(layer, a, x, y), expected, rtol=1e-5, atol=1e-6)
    gradcheck(layer, a, x, y)


def test_axpy_refuses_other_shapes(build: Build) -> None:
    with pytest.raises(SpecError, match=r"found shapes \(2, 3, 1, 2\), .*expected \(N, C, 1, 1\) and twice"):
        build("blocks", 'type: "Axpy"', (2, 3, 1, 2), (2, 3, 4, 5), (2, 3, 4, 5))


def test_relu6_and_its_gradient_at_the_bends(build: Build) -> None:
    x = torch.tensor([-2.0, 0.0, 3.0, 6.0, 7.0, float("inf")], requires_grad=True)
    layer = build("blocks", 'type: "ReLU6" relu6_param { negative_slope: 0.5 }', (6,))
    (top,) = layer.run(x)
    assert top.tolist() == [-1, 0, 3, 6, 6, 6]
    top.sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [0.5, 0.5, 1, 0, 0, 0]
    assert run(build("blocks", 'type: "ReLU6"', (2,)), torch.tensor([float("-inf"), float("nan")]))[0] == 0


def test_relu6_in_place_has_the_gradient_of_what_lies_in_memory() -> None:
    use_dialect("blocks")
    text = """
      layer { name: 'in' type: 'Input' top: 'x' input_param { shape { dim: 5 } } }
      layer { name: 'r' type: 'ReLU6' bottom: 'x' top: 'x' }
      layer { name: 'p' type: 'Power' bottom: 'x' top: 'x' power_param { scale: 2 shift: -1 } }
    """
    net = build_net(*parse_net_text(text, "f"), BuildOptions())
    x = torch.tensor([-1.0, 0.2, 2.0, 4.0, 8.0], requires_grad=True)
    (top,) = net(x=x).values()
    torch.testing.assert_close(top, torch.tensor([-1.0, -0.6, 3.0, 7.0, 11.0]))
    top.sum().backward()
    # Caffe's ReLU6 reads its bottom where Power has written: 0 < -0.6 is false, 7 < 6 is. Its Power in place overwrites
    # the gradient with the slope: 2 times 2.
    assert x.grad is not None
    assert x.grad.tolist() == [0, 0, 4, 0, 0]


CONVOLVED = "kernel_size: 3 pad: 1 stride: 2 weight_filler { type: 'xavier' } bias_filler { type: 'uniform' }"


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        f"type: 'DepthwiseConvolution' convolution_param {{ num_output: 3 group: 3 {CONVOLVED} }}",
        f"type: 'ConvolutionDepthwise' convolution_param {{ num_output: 3 {CONVOLVED} }}",
        f"type: 'ConvolutionDepthwise' convolution_param {{ {CONVOLVED} }}",
    ],
)
def test_depthwise_convolutions(build: Build, gradcheck: Gradcheck, text: str) -> None:
    x = numbers(2, 3, 5, 6)
    layer = build("blocks", text, x.shape)
    assert layer.blob_shapes == [(3, 1, 3, 3), (3,)]
    weight, bias = (blob.detach().numpy() for blob in layer.blobs)
    padded = np.pad(x.numpy(), ((0, 0), (0, 0), (1, 1), (1, 1)))
    expected = np.empty((2, 3, 3, 3), np.float32)
    for n, c, i, j in np.ndindex(*expected.shape):
        window = padded[n, c, 2 * i : 2 * i + 3, 2 * j : 2 * j + 3]
        expected[n, c, i, j] = (window * weight[c, 0]).sum() + bias[c]
    np.testing.assert_allclose(run(layer, x), expected, rtol=1e-5, atol=1e-6)
    gradcheck(layer, x)


def test_depthwise_convolution_is_of_single_channels(build: Build) -> None:
    text = f"type: 'DepthwiseConvolution' convolution_param {{ num_output: 4 group: 2 {CONVOLVED} }}"
    with pytest.raises(SpecError, match="group must be the number of channels, 4, found 2"):
        build("blocks", text, (1, 4, 5, 5))


def test_convolution_depthwise_without_a_bias_and_with_dilation(build: Build) -> None:
    text = (
        "type: 'ConvolutionDepthwise' convolution_param { kernel_size: 3 dilation: 2 bias_term: false num_output: 9 }"
    )
    layer = build("blocks", text, (1, 2, 7, 6))
    assert layer.blob_shapes == [(2, 1, 3, 3)]
    assert layer.top_shapes == [(1, 2, 3, 2)]
    assert layer.ignores == {"convolution_param.group", "convolution_param.num_output"}


def test_shuffle_channel(build: Build, gradcheck: Gradcheck) -> None:
    x = numbers(2, 6, 2, 3)
    layer = build("blocks", "type: 'ShuffleChannel' shuffle_channel_param { group: 3 }", x.shape)
    np.testing.assert_array_equal(run(layer, x), x.numpy()[:, [0, 2, 4, 1, 3, 5]])
    gradcheck(layer, x)
    with pytest.raises(SpecError, match="a multiple of group, 3"):
        layer.run(numbers(2, 7, 2, 3))


def interpolated(maps: np.ndarray, height: int, width: int) -> np.ndarray:
    top = np.empty((*maps.shape[:2], height, width))
    for i, j in np.ndindex(height, width):
        y = i * (maps.shape[2] - 1) / (height - 1) if height > 1 else 0
        x = j * (maps.shape[3] - 1) / (width - 1) if width > 1 else 0
        (u, dy), (v, dx) = (int(y), y % 1), (int(x), x % 1)
        below, right = min(u + 1, maps.shape[2] - 1), min(v + 1, maps.shape[3] - 1)
        top[:, :, i, j] = (1 - dy) * ((1 - dx) * maps[:, :, u, v] + dx * maps[:, :, u, right]) + dy * (
            (1 - dx) * maps[:, :, below, v] + dx * maps[:, :, below, right]
        )
    return top


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ("zoom_factor: 3", (13, 16)),
        ("shrink_factor: 2", (3, 3)),
        ("shrink_factor: 2 zoom_factor: 2", (5, 5)),
        ("height: 4 width: 1", (4, 1)),
        ("height: 5 width: 6", (5, 6)),
        ("zoom_factor: 2 pad_beg: -1", (7, 9)),
        ("height: 6 width: 7 pad_beg: -1 pad_end: -2", (6, 7)),
        ("", (8, 2)),
    ],
)
def test_interp(build: Build, gradcheck: Gradcheck, settings: str, size: tuple[int, int]) -> None:
    x = numbers(2, 2, 5, 6)
    wanted = [numbers(1, 1, *size)] if not settings else []
    bottoms = [x, *wanted]
    layer = build("blocks", f"type: 'Interp' interp_param {{ {settings} }}", *(b.shape for b in bottoms))
    begin = -1 if "pad_beg" in settings else 0
    end = -2 if "pad_end" in settings else 0
    inner = x.numpy()[:, :, -begin : 5 + end, -begin : 6 + end]
    np.testing.assert_allclose(run(layer, *bottoms), interpolated(inner, *size), rtol=1e-5, atol=1e-6)
    gradcheck(layer, *bottoms, fixed=(1,))


def test_upsample_repeats_pixels_without_a_mask(build: Build, gradcheck: Gradcheck) -> None:
    x = numbers(2, 3, 2, 3)
    layer = build("blocks", "type: 'Upsample' upsample_param { scale: 2 }", x.shape)
    np.testing.assert_array_equal(run(layer, x), x.numpy().repeat(2, axis=2).repeat(2, axis=3))
    gradcheck(layer, x)
    assert build("blocks", "type: 'Upsample'", x.shape).top_shapes == [x.shape]


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ("scale: 2", (6, 4)),
        ("", (6, 4)),
        ("scale: 2 pad_out_h: true", (5, 4)),
        ("scale_h: 3 scale_w: 2", (9, 4)),
        ("scale: 2 upsample_h: 7 upsample_w: 5", (7, 5)),
    ],
)
def test_upsample_by_a_mask(build: Build, gradcheck: Gradcheck, settings: str, size: tuple[int, int]) -> None:
    x = numbers(2, 2, 3, 2)
    pixels = np.stack([np.random.default_rng(i).permutation(size[0] * size[1])[:6] for i in range(4)])
    mask = torch.from_numpy(pixels.reshape(2, 2, 3, 2)).float()
    layer = build("blocks", f"type: 'Upsample' upsample_param {{ {settings} }}", x.shape, mask.shape)
    expected = np.zeros((2, 2, size[0] * size[1]), np.float32)
    for n, c, i, j in np.ndindex(2, 2, 3, 2):
        expected[n, c, int(mask[n, c, i, j])] = x[n, c, i, j]
    np.testing.assert_array_equal(run(layer, x, mask), expected.reshape(2, 2, *size))
    gradcheck(layer, x, mask, fixed=(1,))


def test_upsample_keeps_the_last_value_and_gives_each_the_gradient(build: Build) -> None:
    x = torch.tensor([[[[1.0, 2.0], [3.0, 4.0]]]], requires_grad=True)
    mask = torch.tensor([[[[0.0, 5.0], [5.0, 15.0]]]])
    (top,) = build("blocks", "type: 'Upsample' upsample_param { scale: 2 }", x.shape, mask.shape).run(x, mask)
    assert top[0, 0, 1, 1] == 3
    top.backward(torch.arange(16.0).reshape(1, 1, 4, 4))
    assert x.grad is not None
    assert x.grad.flatten().tolist() == [0, 5, 5, 15]


def test_upsample_undoes_pooling() -> None:
    use_dialect("blocks")
    text = """
      layer { name: 'in' type: 'Input' top: 'x' input_param { shape { dim: 1 dim: 2 dim: 5 dim: 6 } } }
      layer { name: 'p' type: 'Pooling' bottom: 'x' top: 'p' top: 'm' pooling_param { kernel_size: 2 stride: 2 } }
      layer { name: 'u' type: 'Upsample' bottom: 'p' bottom: 'm' top: 'u' upsample_param { scale: 2 pad_out_h: true } }
    """
    net = build_net(*parse_net_text(text, "f"), BuildOptions())
    x = numbers(1, 2, 5, 6)
    (top,) = net(x=x).values()
    assert top.shape == x.shape
    kept = top != 0
    assert int(kept.sum()) == 2 * 3 * 3
    assert torch.equal(top[kept], x[kept])


def test_upsample_refuses_a_mask_of_a_larger_map(build: Build) -> None:
    layer = build("blocks", "type: 'Upsample' upsample_param { scale: 2 }", (1, 1, 1, 1), (1, 1, 1, 1))
    with pytest.raises(SpecError, match="the mask names pixel 4, the top has 2 x 2"):
        layer.run(torch.ones(1, 1, 1, 1), torch.full((1, 1, 1, 1), 4.0))


PSPNET = "slope_filler { type: 'uniform' min: 0.5 max: 2 } bias_filler { type: 'uniform' } momentum: 0.8 eps: 0.01"


def normalized(
    x: np.ndarray, mean: np.ndarray, variance: np.ndarray, eps: float, blobs: list[np.ndarray]
) -> np.ndarray:
    return (x - mean) / np.sqrt(variance + eps) * blobs[0] + blobs[1]


def test_bn_of_pspnet(build: Build, gradcheck: Gradcheck) -> None:
    x = numbers(3, 2, 4, 5) * 3 + 1
    layer = build("blocks", f"type: 'BN' bn_param {{ {PSPNET} }}", x.shape, phase=TRAIN)
    assert layer.blob_shapes == [(1, 2, 1, 1)] * 4
    blobs = [blob.detach().numpy().copy() for blob in layer.blobs]
    assert not blobs[2].any()
    assert not blobs[3].any()
    values = x.numpy()
    mean, variance = (f(values, axis=(0, 2, 3), keepdims=True) for f in (np.mean, np.var))
    np.testing.assert_allclose(run(layer, x), normalized(values, mean, variance, 0.01, blobs), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(layer.blobs[2].detach().numpy(), 0.2 * mean, rtol=1e-5)
    np.testing.assert_allclose(layer.blobs[3].detach().numpy(), 0.2 * variance, rtol=1e-5)
    run(layer, x)
    np.testing.assert_allclose(layer.blobs[3].detach().numpy(), (0.8 * 0.2 + 0.2) * variance, rtol=1e-5)

    test = build("blocks", f"type: 'BN' bn_param {{ {PSPNET} }}", x.shape)
    for mine, theirs in zip(test.blobs, layer.blobs, strict=True):
        mine.data.copy_(theirs.data)
    blobs = [blob.detach().numpy().copy() for blob in layer.blobs]
    expected = normalized(values, blobs[2], blobs[3], 0.01, blobs)
    np.testing.assert_allclose(run(test, x), expected, rtol=1e-4, atol=1e-5)
    assert all(np.array_equal(blob.detach().numpy(), kept) for blob, kept in zip(test.blobs, blobs, strict=True))
    gradcheck(test, x)


@pytest.mark.parametrize("shape", [(3, 2), (3, 2, 4, 2)])
def test_gradient_of_bn_by_the_batch(build: Build, gradcheck: Gradcheck, shape: tuple[int, ...]) -> None:
    layer = build("blocks", f"type: 'BN' bn_param {{ {PSPNET} }}", shape, phase=TRAIN)
    gradcheck(layer, numbers(*shape))


def test_frozen_bn_uses_and_keeps_its_moving_averages(build: Build) -> None:
    x = numbers(2, 3, 4, 4)
    layer = build("blocks", f"type: 'BN' bn_param {{ {PSPNET} frozen: true }}", x.shape, phase=TRAIN)
    blobs = [blob.detach().numpy().copy() for blob in layer.blobs]
    assert (blobs[3] == 1).all()
    np.testing.assert_allclose(
        run(layer, x), normalized(x.numpy(), blobs[2], blobs[3], 0.01, blobs), rtol=1e-5, atol=1e-6
    )
    assert (layer.blobs[3] == 1).all()
    assert layer.not_learned == {0, 1, 2, 3}


@pytest.mark.parametrize("params", ["", "param { lr_mult: 2 decay_mult: 0 }", "param {} param {} param {} param {}"])
def test_the_statistics_of_bn_are_never_learned(params: str) -> None:
    use_dialect("blocks")
    text = f"""
      layer {{ name: 'in' type: 'Input' top: 'x' input_param {{ shape {{ dim: 2 dim: 3 }} }} }}
      layer {{ name: 'b' type: 'BN' bottom: 'x' top: 'y' bn_param {{ {PSPNET} }} {params} }}
    """
    net = build_net(*parse_net_text(text, "f"), BuildOptions())
    rates = [(p.lr_mult, p.decay_mult) for p in net.learnable]
    assert rates == [((2.0, 0.0) if "lr_mult" in params else (1.0, 1.0)), (1.0, 1.0), (0.0, 0.0), (0.0, 0.0)]
    assert [p.requires_grad for p in net.params["b"]] == [True, True, False, False]


SEGNET = "scale_filler { type: 'uniform' min: 0.5 max: 2 } shift_filler { type: 'uniform' }"


def test_bn_of_segnet(build: Build, gradcheck: Gradcheck) -> None:
    x = numbers(3, 2, 4, 5) * 3 + 1
    for phase in (0, 1):
        layer = build("blocks", f"type: 'BN' bn_param {{ {SEGNET} }}", x.shape, phase=phase)
        assert layer.blob_shapes == [(1, 2, 1, 1)] * 2
        blobs = [blob.detach().numpy() for blob in layer.blobs]
        mean, variance = (f(x.numpy(), axis=(0, 2, 3), keepdims=True) for f in (np.mean, np.var))
        np.testing.assert_allclose(
            run(layer, x), normalized(x.numpy(), mean, variance, 1e-9, blobs), rtol=1e-4, atol=1e-5
        )
    layer = build("blocks", f"type: 'BN' bn_param {{ {SEGNET} bn_mode: INFERENCE }}", x.shape)
    blobs = [blob.detach().numpy() for blob in layer.blobs]
    np.testing.assert_allclose(run(layer, x), x.numpy() * blobs[0] + blobs[1], rtol=1e-5, atol=1e-6)
    gradcheck(layer, x)


def test_bn_refuses_two_forks_at_once(build: Build) -> None:
    with pytest.raises(SpecError, match="momentum is PSPNet's and bn_mode is SegNet's; use one kind only"):
        build("blocks", "type: 'BN' bn_param { momentum: 0.9 bn_mode: INFERENCE }", (2, 3, 4, 4))


def test_every_layer_says_what_it_takes_and_gives() -> None:
    for name in ("ssd", "rcnn", "blocks", "layout", "yolo", "ristretto"):
        before = set(layer_types())
        use_dialect(name)
        for kind in set(layer_types()) - before:
            cls = layer_class(kind)
            assert cls is not None
            doc = str(cls.__doc__)
            assert "bottom[" in doc or cls.bottoms == (0, 0), kind
            assert "top[" in doc, kind
            assert "Fork: " in doc, kind


@pytest.mark.parametrize(("how", "flag"), [("BILINEAR", cv2.INTER_LINEAR), ("NEAREST", cv2.INTER_NEAREST)])
@pytest.mark.parametrize(
    ("given", "size"), [("new_height: 11 new_width: 4", (11, 4)), ("scale_h: 2 scale_w: 2.5", (10, 15))]
)
def test_maps_are_resized_as_opencv_does(
    build: Build, gradcheck: Gradcheck, given: str, size: tuple[int, int], how: str, flag: int
) -> None:
    data = torch.randn(2, 3, 5, 6)
    layer = build("blocks", f"type: 'DeephiResize' deephi_resize_param {{ {given} resize_type: {how} }}", data.shape)
    top = run(layer, data)
    for n, c in np.ndindex(2, 3):
        expected = cv2.resize(data[n, c].numpy(), size[::-1], interpolation=flag)
        np.testing.assert_allclose(top[n, c], expected, rtol=1e-5, atol=1e-5)
    gradcheck(layer, data)
    with pytest.raises(SpecError, match="expected new_height and new_width, or scale_h and scale_w"):
        build("blocks", "type: 'DeephiResize' deephi_resize_param { new_height: 3 }", data.shape)
