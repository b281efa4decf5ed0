"""Gradients of blobs with ``lr_mult: 0``: those that Caffe's layers compute although nothing learns from them."""

from collections.abc import Callable

import pytest
import torch

from netspec.net.net import Net
from netspec.proto.schema import TRAIN

FILL = 'weight_filler { type: "gaussian" std: 0.5 }'
HEAD = """
layer { name: "d" type: "DummyData" top: "x" top: "cont" top: "id" dummy_data_param {
  shape { dim: 3 dim: 2 dim: 4 } shape { dim: 3 dim: 2 } shape { dim: 3 }
  data_filler { type: "gaussian" } data_filler { value: 1 } data_filler { value: 1 } } }
layer { name: "quiet" type: "Silence" bottom: "cont" bottom: "id" }
layer { name: "low" type: "Scale" bottom: "x" top: "low" param { lr_mult: LOW } }
"""
SLIDE = f"convolution_param {{ axis: 1 kernel_size: 3 num_output: 2 {FILL} }}"
SQUARES = 'type: "Reduction" loss_weight: 1 reduction_param { operation: SUMSQ }'
FROZEN = "param { lr_mult: 0 } param { lr_mult: 0 }"
LAYERS = {
    "Bias": ('type: "Bias" bottom: "low" param { lr_mult: 0 }', False),
    "Convolution": (f'type: "Convolution" bottom: "low" {FROZEN} {SLIDE}', False),
    "Deconvolution": (f'type: "Deconvolution" bottom: "low" {FROZEN} {SLIDE}', False),
    "Embed": (f'type: "Embed" bottom: "id" {FROZEN} embed_param {{ input_dim: 2 num_output: 2 {FILL} }}', False),
    "InnerProduct": (
        f'type: "InnerProduct" bottom: "low" {FROZEN} inner_product_param {{ num_output: 2 {FILL} }}',
        False,
    ),
    "Parameter": ('type: "Parameter" param { lr_mult: 0 } parameter_param { shape { dim: 2 } }', False),
    "PReLU": ('type: "PReLU" bottom: "low" param { lr_mult: 0 }', False),
    "Scale": (f'type: "Scale" bottom: "low" {FROZEN} scale_param {{ bias_term: true }}', False),
    "LSTM": (
        f'type: "LSTM" bottom: "low" bottom: "cont" {FROZEN} param {{ lr_mult: 0 }}'
        f" recurrent_param {{ num_output: 2 {FILL} }}",
        True,
    ),
    "RNN": (
        f'type: "RNN" bottom: "low" bottom: "cont" {FROZEN * 2} param {{ lr_mult: 0 }}'
        f" recurrent_param {{ num_output: 2 {FILL} }}",
        True,
    ),
}


def gradients(net: Net, layer: str) -> list[bool]:
    """Return which blobs of the layer have a gradient other than zero after a pass."""
    loss = net.forward_loss()[0]
    if loss.requires_grad:
        loss.backward()
    grads = [blob.grad for blob in net.params[layer]]
    return [grad is not None and bool(grad.any()) for grad in grads]


def net_with(net_of: Callable[..., Net], layer: str, low: int, as_caffe: bool) -> Net:
    text = f'layer {{ name: "it" top: "y" {layer} }}'
    end = f'layer {{ name: "end" {SQUARES} bottom: "y" top: "end" }}'
    return net_of(HEAD.replace("LOW", str(low)) + text + end, TRAIN, accumulate_in_place=as_caffe, seed=3)


@pytest.mark.parametrize(("layer", "ignores"), LAYERS.values(), ids=LAYERS)
def test_only_recurrent_layers_compute_gradients_of_frozen_blobs(
    layer: str, ignores: bool, net_of: Callable[..., Net]
) -> None:
    net = net_with(net_of, layer, 1, as_caffe=True)
    found = gradients(net, "it")
    assert found == [ignores] * len(found)
    assert not any(gradients(net_with(net_of, layer, 1, as_caffe=False), "it"))


@pytest.mark.parametrize("layer", ["LSTM", "RNN"])
def test_recurrent_layers_that_need_no_backward_pass_compute_none(layer: str, net_of: Callable[..., Net]) -> None:
    net = net_with(net_of, LAYERS[layer][0], 0, as_caffe=True)
    assert not any(gradients(net, "it"))
    assert not any(blob.requires_grad for blob in net.params["it"])


@pytest.mark.parametrize("frozen", ["a", "b"])
def test_of_two_layers_the_one_without_lr_mult_0_computes_the_gradient_of_a_shared_blob(
    frozen: str, net_of: Callable[..., Net]
) -> None:
    """``lr_mult: 0`` holds for the update of a shared blob, but each layer reads its own ``param``."""
    text, weights = HEAD.replace("LOW", "1"), {"a": 1, "b": 3}
    for name in "ab":
        rate = "lr_mult: 0" if name == frozen else ""
        text += f"""
layer {{ name: "{name}" type: "InnerProduct" bottom: "low" top: "{name}" param {{ name: "w" {rate} }}
  inner_product_param {{ num_output: 2 bias_term: false {FILL} }} }}
layer {{ name: "end {name}" type: "Reduction" bottom: "{name}" top: "end {name}" loss_weight: {weights[name]} }}
"""
    net = net_of(text, TRAIN, accumulate_in_place=True, seed=3)
    net.keep = "all"
    net.forward_loss()[0].backward()
    (w,) = net.params["a"]
    assert w.grad is not None
    rows = net.blobs["low"].detach().flatten(1).sum(0)
    weight = weights["b" if frozen == "a" else "a"]
    torch.testing.assert_close(w.grad, torch.stack([weight * rows] * 2))
    assert [item.lr_mult for item in net.learnable] == [1, 0]


def test_batch_norm_without_param_needs_a_backward_pass(net_of: Callable[..., Net]) -> None:
    """Caffe's Net reads the prototxt, where the ``lr_mult: 0`` is missing that the layer gives itself."""
    text = 'layer { name: "bn" type: "BatchNorm" bottom: "x" top: "bn" PARAM }'
    text = HEAD.replace("LOW", "0") + text
    text += 'layer { name: "end" type: "Reduction" bottom: "bn" top: "end" loss_weight: 1 }'
    for given, needs in (("", True), ("param { lr_mult: 0 }", True), ("param { lr_mult: 0 } " * 3, False)):
        net = net_of(text.replace("PARAM", given), TRAIN)
        reached = dict(zip([node.name for node in net.plan.nodes], net.backward_plan.layers, strict=True))
        assert (reached["bn"], reached["end"], reached["d"]) == (needs, needs, False)
        assert not any(blob.requires_grad for blob in net.params["bn"])
