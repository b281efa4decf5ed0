"""Fields that forks added to Caffe's layers: hole, scale_bias, relu6, scale_train, sample_weights_test."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from fresh_dialects import used_by
from netspec.layers import Layer, activation
from netspec.layers.vision import pooling
from netspec.net.build import build_net
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net_text

Build = Callable[..., Layer]
Gradcheck = Callable[..., None]


def test_hole_in_a_file_of_the_older_format_activates_the_dialect() -> None:
    """DeepLab's files are of 2015: ``layers``, types without quotes, ``hole``."""
    text = """input: "data" input_dim: 1 input_dim: 3 input_dim: 9 input_dim: 9
        layers { bottom: "data" top: "fc6" name: "fc6" type: CONVOLUTION
          convolution_param { num_output: 4 pad: 2 hole: 2 kernel_size: 3 } }"""
    assert used_by(text) == ["filters"]
    assert build_net(*parse_net_text(text, "net.prototxt")).shapes["fc6"] == (1, 4, 9, 9)


NORM = "type: 'BatchNorm' batch_norm_param { eps: 0.01 scale_bias: true %s }"


def test_batch_norm_with_scale_bias_is_initialized_to_slope_one_and_bias_zero(build: Build) -> None:
    layer = build("nvidia", NORM % "", (2, 3))
    assert layer.blobs[3].tolist() == [1, 1, 1]
    assert layer.blobs[4].tolist() == [0, 0, 0]
    assert len(build("nvidia", "type: 'BatchNorm'", (2, 3)).blobs) == 3


@pytest.mark.parametrize(
    ("fields", "slope", "bias"),
    [
        ("scale_filler { value: 3 } bias_filler { value: 1 }", 3, 1),
        ("scale_filler { value: 3 }", 3, 0),
        ("bias_filler { value: 2 }", 1, 2),
        ("scale_bias: true scale_filler { value: 3 }", 3, 0),
        ("use_weight_bias: true", 1, 0),  # Intel's
        ("filler { value: 3 } bias_filler { value: 1 }", 3, 1),
        ("use_weight_bias: true filler { value: 3 } engine: MKLDNN", 3, 0),
    ],
)
def test_a_filler_of_batch_norm_implies_slopes_and_biases(build: Build, fields: str, slope: float, bias: float) -> None:
    x = torch.randn(4, 2, 3, 3, generator=torch.Generator().manual_seed(0))
    layer = build("nvidia", f"type: 'BatchNorm' batch_norm_param {{ {fields} }}", tuple(x.shape), phase=TRAIN)
    assert [tuple(blob.shape) for blob in layer.blobs] == [(2,), (2,), (1,), (2,), (2,)]
    top = layer(x).detach()
    np.testing.assert_allclose(top.mean(dim=(0, 2, 3)).tolist(), bias, atol=1e-5)
    np.testing.assert_allclose(top.std(dim=(0, 2, 3), unbiased=False).tolist(), slope, rtol=1e-4)


@pytest.mark.parametrize("fields", ["use_weight_bias: false", "scale_bias: false", "engine: CUDNN", "bias_term: true"])
def test_without_slopes_batch_norm_has_caffes_three_blobs(build: Build, fields: str) -> None:
    assert len(build("nvidia", f"type: 'BatchNorm' batch_norm_param {{ {fields} }}", (2, 3)).blobs) == 3


@pytest.mark.parametrize(
    ("fields", "given", "expected"),
    [
        ("scale_bias: true", "", [(0, 0)] * 3 + [(1, 1)] * 2),
        ("scale_bias: true", "param { lr_mult: 2 } " * 5, [(0, 0)] * 3 + [(1, 1)] * 2),
        ("filler { value: 1 }", "param { lr_mult: 0 } " * 3, [(0, 0)] * 3 + [(1, 1)] * 2),
        ("filler { value: 1 }", "", [(0, 1)] * 3 + [(1, 1)] * 2),
        ("filler { value: 1 }", "param { lr_mult: 0 } " * 3 + "param { lr_mult: 3 }", [(0, 1)] * 3 + [(3, 1), (1, 1)]),
    ],
    ids=["nvidia", "nvidia_whatever_is_written", "intel", "intel_default", "intel_as_written"],
)
def test_how_the_blobs_of_batch_norm_are_learned(fields: str, given: str, expected: list[tuple[float, float]]) -> None:
    text = f"""layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: 2 dim: 3 }} }} }}
        layer {{ name: "y" type: "BatchNorm" bottom: "x" top: "y" {given} batch_norm_param {{ {fields} }} }}"""
    net = build_net(*parse_net_text(text, "n.prototxt"))
    assert [(each.lr_mult, each.decay_mult) for each in net.learnable] == expected


def test_nvidias_statistics_are_moving_averages(build: Build) -> None:
    """cuDNN's: the first batch's as they are, then with the weight 1 - moving_average_fraction; variances unbiased."""
    layer = build("nvidia", NORM % "moving_average_fraction: 0.75", (4, 3), phase=TRAIN)
    batches = [torch.randn(4, 3, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1)]
    for batch in batches:
        layer(batch)
    first, second = (torch.stack([batch.mean(0), batch.var(0)]) for batch in batches)
    found = torch.stack([layer.blob(0), layer.blob(1)]).detach()
    np.testing.assert_allclose(found, 0.75 * first + 0.25 * second, rtol=1e-5)
    assert layer.blob(2).tolist() == [1]


def test_nvidias_batch_norm_reads_weights_in_which_statistics_are_sums(build: Build) -> None:
    layer = build("nvidia", NORM % "moving_average_fraction: 0.75", (4, 3), phase=TRAIN)
    with torch.no_grad():
        for i, value in enumerate((6.0, 8.0, 2.0)):
            layer.blob(i).fill_(value)
    batch = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    layer(batch)
    np.testing.assert_allclose(layer.blob(0).detach(), 0.75 * 3 + 0.25 * batch.mean(0), rtol=1e-5)
    np.testing.assert_allclose(layer.blob(1).detach(), 0.75 * 4 + 0.25 * batch.var(0), rtol=1e-5)


def test_nvidias_eps_is_at_least_1e_5(build: Build) -> None:
    fields = "type: 'BatchNorm' batch_norm_param {{ eps: 1e-9 {} }}"
    assert build("nvidia", fields.format("scale_bias: true"), (2, 3)).eps == 1e-5
    assert build("nvidia", fields.format("filler { value: 1 }"), (2, 3)).eps == pytest.approx(1e-9)


POOL = "type: 'Pooling' pooling_param { kernel_size: 3 stride: 2 %s }"


def test_layers_without_these_fields_are_caffes_own(build: Build) -> None:
    assert type(build("filters", POOL % "pad: 1", (1, 1, 5, 5))) is pooling.Pooling
    assert type(build("filters", "type: 'ReLU'", (1, 1, 5, 5))) is activation.ReLU


@pytest.mark.parametrize("slope", [0.0, 0.25])
def test_relu6_clips_at_six(build: Build, gradcheck: Gradcheck, slope: float) -> None:
    data = torch.tensor([[-4.0, -1, 0, 2, 6, 7]])
    layer = build("filters", f"type: 'ReLU' relu_param {{ relu6: true negative_slope: {slope} }}", data.shape)
    assert layer.run(data)[0].tolist() == [[-4 * slope, -slope, 0, 2, 6, 6]]
    gradcheck(layer, torch.tensor([[-4.0, -1, 0.5, 2, 5, 7]]))


@pytest.mark.parametrize(("phase", "factor"), [(TRAIN, 1), (TEST, 0.75)])
def test_dropout_without_scale_train_scales_in_testing(build: Build, phase: int, factor: float) -> None:
    x = torch.rand(1000) + 1
    text = "type: 'Dropout' dropout_param { dropout_ratio: 0.25 scale_train: false }"
    top = build("filters", text, x.shape, phase=phase).run(x)[0].numpy()
    kept = top != 0
    np.testing.assert_allclose(top[kept], factor * x.numpy()[kept], rtol=1e-6)
    assert kept.all() == (phase == TEST)
    plain = build("filters", "type: 'Dropout' dropout_param { dropout_ratio: 0.25 }", x.shape, phase=phase)
    usual = plain.run(x)[0].numpy()
    np.testing.assert_allclose(usual[usual != 0], x.numpy()[usual != 0] / (0.75 if phase == TRAIN else 1), rtol=1e-6)


def test_dropout_with_sample_weights_test_draws_in_testing(build: Build) -> None:
    text = "type: 'Dropout' dropout_param { sample_weights_test: true }"
    layer = build("filters", text, (1000,), phase=TEST)
    first, second = (layer.run(torch.ones(1000))[0] for _ in range(2))
    assert set(first.tolist()) == {0, 2}
    assert not torch.equal(first, second)
