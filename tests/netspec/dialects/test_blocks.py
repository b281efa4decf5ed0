"""Dialects blocks and layout, the layers that many forks share: special cases beside those of test_cases.py."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from netspec import use_dialect
from netspec.errors import SpecError
from netspec.graph.options import BuildOptions
from netspec.layers import Layer, layer_class, layer_types
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.text import parse_net_text

Build = Callable[..., Layer]


def run(layer: Layer, *bottoms: torch.Tensor) -> np.ndarray:
    (top,) = layer.run(*bottoms)
    assert [tuple(top.shape)] == layer.top_shapes
    return top.detach().numpy()


def test_relu6_values_and_gradients_at_zero_and_six(build: Build) -> None:
    x = torch.tensor([-2.0, 0.0, 3.0, 6.0, 7.0, float("inf")], requires_grad=True)
    layer = build("blocks", 'type: "ReLU6" relu6_param { negative_slope: 0.5 }', (6,))
    (top,) = layer.run(x)
    assert top.tolist() == [-1, 0, 3, 6, 6, 6]
    top.sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [0.5, 0.5, 1, 0, 0, 0]
    assert run(build("blocks", 'type: "ReLU6"', (2,)), torch.tensor([float("-inf"), float("nan")]))[0] == 0


def test_relu6_in_place_has_the_gradient_of_the_data_in_memory() -> None:
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


def test_convolution_depthwise_without_a_bias_and_with_dilation(build: Build) -> None:
    text = (
        "type: 'ConvolutionDepthwise' convolution_param { kernel_size: 3 dilation: 2 bias_term: false num_output: 9 }"
    )
    layer = build("blocks", text, (1, 2, 7, 6))
    assert layer.blob_shapes == [(2, 1, 3, 3)]
    assert layer.top_shapes == [(1, 2, 3, 2)]
    assert layer.ignores == {"convolution_param.group", "convolution_param.num_output"}


def test_shuffle_channel_refuses_channels_that_are_no_multiple_of_its_groups(build: Build) -> None:
    layer = build("blocks", "type: 'ShuffleChannel' shuffle_channel_param { group: 3 }", (2, 6, 2, 3))
    with pytest.raises(SpecError, match="a multiple of group, 3"):
        layer.run(torch.zeros(2, 7, 2, 3))


def test_upsample_of_a_repeated_index_keeps_the_last_value_and_all_get_the_gradient(build: Build) -> None:
    x = torch.tensor([[[[1.0, 2.0], [3.0, 4.0]]]], requires_grad=True)
    mask = torch.tensor([[[[0.0, 5.0], [5.0, 15.0]]]])
    (top,) = build("blocks", "type: 'Upsample' upsample_param { scale: 2 }", x.shape, mask.shape).run(x, mask)
    assert top[0, 0, 1, 1] == 3
    top.backward(torch.arange(16.0).reshape(1, 1, 4, 4))
    assert x.grad is not None
    assert x.grad.flatten().tolist() == [0, 5, 5, 15]


def test_upsample_refuses_a_mask_of_a_larger_map(build: Build) -> None:
    layer = build("blocks", "type: 'Upsample' upsample_param { scale: 2 }", (1, 1, 1, 1), (1, 1, 1, 1))
    with pytest.raises(SpecError, match="the mask names pixel 4, the top has 2 x 2"):
        layer.run(torch.ones(1, 1, 1, 1), torch.full((1, 1, 1, 1), 4.0))


PSPNET = "slope_filler { type: 'uniform' min: 0.5 max: 2 } bias_filler { type: 'uniform' } momentum: 0.8 eps: 0.01"


@pytest.mark.parametrize(
    "params",
    ["", "param { lr_mult: 2 decay_mult: 0 }", "param {} param {} param {} param {}"],
    ids=["no_param", "one_param", "four_params"],
)
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


def test_every_layer_documents_its_bottoms_and_tops() -> None:
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


def test_merge_crop_concatenates_or_adds_the_cropped_bottom(build: Build) -> None:
    small, large = torch.randn(2, 3, 4, 2), torch.randn(2, 3, 7, 4)
    cut = large[:, :, 1:5, 1:3]
    layer = build("layout", "type: 'MergeCrop'", small.shape, large.shape)
    np.testing.assert_array_equal(run(layer, small, large), torch.cat([small, cut], 1))
    layer = build("layout", "type: 'MergeCrop' mergecrop_param { operation: ADD }", small.shape, large.shape)
    np.testing.assert_array_equal(run(layer, small, large), small + cut)
    only = "type: 'MergeCrop' mergecrop_param { forward: [0, 1] }"
    layer = build("layout", only, small.shape, large.shape)
    np.testing.assert_array_equal(run(layer, small, large), torch.cat([torch.zeros_like(small), cut], 1))


@pytest.mark.parametrize(
    ("param", "learns"), [("", (True, False)), ("backward: 0 backward: 1", (False, True))], ids=["first", "second"]
)
def test_merge_crop_computes_the_requested_gradients(build: Build, param: str, learns: tuple[bool, bool]) -> None:
    bottoms = [torch.randn(1, 2, 2, 2, requires_grad=True), torch.randn(1, 2, 4, 4, requires_grad=True)]
    layer = build("layout", f"type: 'MergeCrop' mergecrop_param {{ {param} }}", (1, 2, 2, 2), (1, 2, 4, 4))
    layer.run(*bottoms)[0].sum().backward()
    assert tuple(bottom.grad is not None for bottom in bottoms) == learns
    if learns[1]:
        assert bottoms[1].grad is not None
        assert bottoms[1].grad[0, 0].tolist() == [[0, 0, 0, 0], [0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]]


def test_old_layers_of_deeplab_are_read(net_of: Callable[..., Net]) -> None:
    net = net_of("""
    input: "x" input_dim: [1, 2, 5, 5] input: "l" input_dim: [1, 1, 9, 9]
    layers { name: "c" type: CONVOLUTION strict_dim: false bottom: "x" top: "c"
             convolution_param { num_output: 3 kernel_size: 1 } }
    layers { name: "i" type: INTERP bottom: "c" top: "i" interp_param { zoom_factor: 2 } }
    layers { name: "a" type: SEG_ACCURACY bottom: "i" bottom: "l" top: "a" seg_accuracy_param { ignore_label: 255 } }
    """)
    assert [layer.type for layer in net.layers[1:]] == ["Convolution", "Interp", "SegAccuracy"]
    assert net.shapes["i"] == (1, 3, 9, 9)


@pytest.mark.parametrize(
    "text", ['layer { type: "MatWrite" name: "m" }', 'layers { type: MAT_WRITE name: "m" }'], ids=["layer", "layers"]
)
def test_a_layer_that_no_dialect_has_is_refused_with_its_fork(net_of: Callable[..., Net], text: str) -> None:
    with pytest.raises(SpecError, match="it is of DeepLab, and not here"):
        net_of(text)
