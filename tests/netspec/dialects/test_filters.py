"""Fields that forks added to Caffe's layers: hole, scale_bias, relu6, scale_train, sample_weights_test."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from fresh_dialects import activated_by
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
    assert activated_by(text) == ["filters"]
    assert build_net(*parse_net_text(text, "net.prototxt")).shapes["fc6"] == (1, 4, 9, 9)


NORM = "type: 'BatchNorm' batch_norm_param { eps: 0.01 scale_bias: true %s }"


def test_batch_norm_with_scale_bias_is_initialized_to_slope_one_and_bias_zero(build: Build) -> None:
    layer = build("nvidia", NORM % "", (2, 3))
    assert layer.blobs[3].tolist() == [1, 1, 1]
    assert layer.blobs[4].tolist() == [0, 0, 0]
    assert len(build("nvidia", "type: 'BatchNorm'", (2, 3)).blobs) == 3


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
