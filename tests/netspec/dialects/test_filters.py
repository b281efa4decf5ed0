"""Fields that forks added to Caffe's own layers: Convolution's holes and sides, BatchNorm's slopes and biases."""

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from netspec.dialects import use_dialects_of
from netspec.errors import SpecError
from netspec.layers import Layer, activation
from netspec.layers.vision import pooling
from netspec.net.build import build_net
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net_text

Build = Callable[..., Layer]
Gradcheck = Callable[..., None]
CONV = "type: 'Convolution' convolution_param { num_output: 4 kernel_size: 3 weight_filler { type: 'xavier' } %s }"


@pytest.mark.parametrize(
    ("given", "dilation"), [("hole: 2", (2, 2)), ("hole_h: 1 hole_w: 2", (1, 2)), ("dilation: 3", (3, 3)), ("", (1, 1))]
)
def test_a_hole_is_a_dilation(build: Build, given: str, dilation: tuple[int, int]) -> None:
    data = torch.randn(2, 3, 9, 8)
    layer = build("filters", CONV % given, data.shape)
    (top,) = layer.run(data)
    np.testing.assert_allclose(
        top.detach(), F.conv2d(data, *layer.blobs, dilation=dilation).detach(), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("stride", [1, 2])
def test_each_side_has_its_pad(build: Build, gradcheck: Gradcheck, stride: int) -> None:
    data = torch.randn(2, 3, 6, 5)
    sides = f"stride: {stride} pad_l: 2 pad_r: 1 pad_b: 3"
    layer = build("filters", CONV % sides, data.shape)
    (top,) = layer.run(data)
    assert layer.top_shapes == [tuple(top.shape)]
    expected = F.conv2d(F.pad(data, (2, 1, 0, 3)), *layer.blobs, stride=stride)
    np.testing.assert_allclose(top.detach(), expected.detach(), rtol=1e-4, atol=1e-5)
    gradcheck(build("filters", CONV % sides, (1, 2, 3, 3)), torch.randn(1, 2, 3, 3))


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ("hole: 2 dilation: 2", "found hole beside dilation"),
        ("hole_h: 2", "or both hole_h and hole_w; found hole_h"),
        ("hole: 0", "hole must be at least 1"),
        ("pad: 1 pad_t: 1", "found both pad and pad_t"),
    ],
)
def test_contradictions_are_refused(build: Build, given: str, fault: str) -> None:
    with pytest.raises(SpecError, match=fault):
        build("filters", CONV % given, (1, 3, 9, 9))


def test_the_dialect_is_found_in_a_file_of_the_older_format() -> None:
    """DeepLab's files are of 2015: ``layers``, types without quotes, ``hole``."""
    text = """input: "data" input_dim: 1 input_dim: 3 input_dim: 9 input_dim: 9
        layers { bottom: "data" top: "fc6" name: "fc6" type: CONVOLUTION
          convolution_param { num_output: 4 pad: 2 hole: 2 kernel_size: 3 } }"""
    assert use_dialects_of(text, "net.prototxt") == ["filters"]
    assert build_net(*parse_net_text(text, "net.prototxt")).shapes["fc6"] == (1, 4, 9, 9)


NORM = "type: 'BatchNorm' batch_norm_param { eps: 0.01 scale_bias: true %s }"


def test_batch_norm_with_slopes_and_biases(build: Build, gradcheck: Gradcheck) -> None:
    data = torch.randn(4, 3, 5, 2)
    fillers = "scale_filler { type: 'uniform' min: 1 max: 2 } bias_filler { type: 'uniform' min: 1 max: 2 }"
    layer = build("nvidia", NORM % fillers, data.shape)
    assert layer.blob_shapes == [(3,), (3,), (1,), (3,), (3,)]
    assert layer.not_learned == {0, 1, 2}
    with torch.no_grad():
        for blob, values in zip(layer.blobs, ([1.0, 2, 3], [4.0, 5, 6], [2.0]), strict=False):
            blob.copy_(torch.tensor(values))
    mean, variance, weight, slope, bias = (blob.detach() for blob in layer.blobs)
    expected = F.batch_norm(data, mean / weight, variance / weight, slope, bias, eps=0.01)
    np.testing.assert_allclose(layer.run(data)[0].detach(), expected, rtol=1e-4, atol=1e-5)
    trained = build("nvidia", NORM % fillers, data.shape, phase=TRAIN)
    expected = F.batch_norm(data, None, None, *(trained.blobs[i].detach() for i in (3, 4)), training=True, eps=0.01)
    np.testing.assert_allclose(trained.run(data)[0].detach(), expected, rtol=1e-4, atol=1e-5)
    gradcheck(build("nvidia", NORM % fillers, (3, 2), phase=TRAIN), torch.randn(3, 2))


def test_batch_norm_begins_with_slopes_of_1_and_is_caffes_without_them(build: Build) -> None:
    layer = build("nvidia", NORM % "", (2, 3))
    assert layer.blobs[3].tolist() == [1, 1, 1]
    assert layer.blobs[4].tolist() == [0, 0, 0]
    assert len(build("nvidia", "type: 'BatchNorm'", (2, 3)).blobs) == 3


POOL = "type: 'Pooling' pooling_param { kernel_size: 3 stride: 2 %s }"
SIDES = [("", (0, 0, 0, 0)), ("pad: 1", (1, 1, 1, 1)), ("pad_l: 1 pad_b: 2", (1, 0, 0, 2)), ("pad_r: 2", (0, 2, 0, 0))]


def pooled(data: torch.Tensor, method: str, sides: tuple[int, ...], floor: bool) -> np.ndarray:
    """Return what a loop over windows of 3 x 3, at stride 2, finds; ``sides`` are left, right, top and bottom."""
    left, right, above, below = sides
    spans = []
    for size, before, after in ((data.shape[2], above, below), (data.shape[3], left, right)):
        count = (size + before + after - 3) // 2 + 1 if floor else -(-(size + before + after - 3) // 2) + 1
        count -= any(sides) and (count - 1) * 2 >= size + before
        spans.append([(2 * i - before, min(2 * i - before + 3, size + after)) for i in range(count)])
    found = np.zeros((*data.shape[:2], *map(len, spans)), np.float32)
    for n, c, i, j in np.ndindex(*found.shape):
        (y0, y1), (x0, x1) = spans[0][i], spans[1][j]
        area = (y1 - y0) * (x1 - x0)
        inside = [float(v) for v in data[n, c, max(y0, 0) : y1, max(x0, 0) : x1].flatten()]
        found[n, c, i, j] = max(inside) if method == "MAX" else sum(inside) / (area if method == "AVE" else len(inside))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("floor", [False, True])
@pytest.mark.parametrize(("given", "sides"), SIDES)
@pytest.mark.parametrize("method", ["MAX", "AVE", "AVE_EXC_PAD", "AVE_TF"])
def test_pooling_with_a_pad_for_each_side_and_of_pixels_alone(
    build: Build, gradcheck: Gradcheck, method: str, given: str, sides: tuple[int, ...], floor: bool
) -> None:
    data = torch.randn(2, 2, 7, 6)
    layer = build("filters", POOL % f"pool: {method} {given} ceil_mode: {str(not floor).lower()}", data.shape)
    (top,) = layer.run(data)
    assert layer.top_shapes == [tuple(top.shape)]
    np.testing.assert_allclose(top.detach(), pooled(data, method, sides, floor), rtol=1e-5, atol=1e-6)
    gradcheck(layer, data)
    assert type(copy.deepcopy(layer)) is type(layer)


def test_pooling_without_these_fields_is_caffes_own(build: Build) -> None:
    assert type(build("filters", POOL % "pad: 1", (1, 1, 5, 5))) is pooling.Pooling
    assert type(build("filters", "type: 'ReLU'", (1, 1, 5, 5))) is activation.ReLU


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ("pad: 1 pad_l: 1", "found both pad and a pad"),
        ("pad_l: 3", "a pad of 3 must be less"),
        ("pool: AVG_EX_PAD", "AVE_EXC_PAD"),
    ],
)
def test_contradictions_of_pooling_are_refused(build: Build, given: str, fault: str) -> None:
    with pytest.raises(SpecError, match=fault):
        build("filters", POOL % given, (1, 3, 9, 9))


@pytest.mark.parametrize("slope", [0.0, 0.25])
def test_relu6(build: Build, gradcheck: Gradcheck, slope: float) -> None:
    data = torch.tensor([[-4.0, -1, 0, 2, 6, 7]])
    layer = build("filters", f"type: 'ReLU' relu_param {{ relu6: true negative_slope: {slope} }}", data.shape)
    assert layer.run(data)[0].tolist() == [[-4 * slope, -slope, 0, 2, 6, 6]]
    gradcheck(layer, torch.tensor([[-4.0, -1, 0.5, 2, 5, 7]]))


@pytest.mark.parametrize(("phase", "factor"), [(TRAIN, 1), (TEST, 0.75)])
def test_dropout_that_scales_in_testing(build: Build, phase: int, factor: float) -> None:
    x = torch.rand(1000) + 1
    text = "type: 'Dropout' dropout_param { dropout_ratio: 0.25 scale_train: false }"
    top = build("filters", text, x.shape, phase=phase).run(x)[0].numpy()
    kept = top != 0
    np.testing.assert_allclose(top[kept], factor * x.numpy()[kept], rtol=1e-6)
    assert kept.all() == (phase == TEST)
    plain = build("filters", "type: 'Dropout' dropout_param { dropout_ratio: 0.25 }", x.shape, phase=phase)
    usual = plain.run(x)[0].numpy()
    np.testing.assert_allclose(usual[usual != 0], x.numpy()[usual != 0] / (0.75 if phase == TRAIN else 1), rtol=1e-6)


def test_dropout_that_draws_in_testing(build: Build) -> None:
    text = "type: 'Dropout' dropout_param { sample_weights_test: true }"
    layer = build("filters", text, (1000,), phase=TEST)
    first, second = (layer.run(torch.ones(1000))[0] for _ in range(2))
    assert set(first.tolist()) == {0, 2}
    assert not torch.equal(first, second)
