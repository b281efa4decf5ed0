"""Layers that compute the gradient of a bottom even with ``propagate_down: false``, as Caffe's do."""

from collections.abc import Callable

import pytest
import torch

from netspec.net.net import Net
from netspec.proto.schema import TRAIN

TWO_READERS = """
layer {{ name: "low" type: "Parameter" top: "low" parameter_param {{ shape {{ dim: 2 dim: 1 dim: 3 dim: 1 }} }} }}
layer {{ name: "cont" type: "DummyData" top: "cont" dummy_data_param {{ shape {{ dim: 2 dim: 1 }} }} }}
layer {{ name: "it" bottom: "low" top: "it" {layer} }}
layer {{ name: "sum" type: "Reduction" bottom: "it" top: "sum" reduction_param {{ operation: SUMSQ }} loss_weight: 1 }}
layer {{ name: "other" type: "Reduction" bottom: "low" top: "other" loss_weight: 1 }}
"""
IGNORE_IT = {
    "Concat of one bottom": 'type: "Concat" propagate_down: false',
    "Slice into one top": 'type: "Slice" propagate_down: false',
    "Flatten": 'type: "Flatten" propagate_down: false',
    "MVN": 'type: "MVN" propagate_down: false mvn_param { across_channels: true }',
    "LRN": 'type: "LRN" propagate_down: false',
    "RNN": 'type: "RNN" bottom: "cont" propagate_down: [false, false] recurrent_param { num_output: 2'
    ' weight_filler { type: "constant" value: 0.5 } bias_filler { type: "constant" value: 1 } }',
    "LSTM": 'type: "LSTM" bottom: "cont" propagate_down: [false, false] recurrent_param { num_output: 2'
    ' weight_filler { type: "constant" value: 0.5 } bias_filler { type: "constant" value: 1 } }',
}
HEED_IT = {
    "ReLU": 'type: "ReLU" propagate_down: false',
    "Tile": 'type: "Tile" propagate_down: false tile_param { tiles: 2 }',
    "LRN in a channel": 'type: "LRN" propagate_down: false lrn_param { norm_region: WITHIN_CHANNEL }',
}
CASES = [(text, True) for text in IGNORE_IT.values()] + [(text, False) for text in HEED_IT.values()]


def gradient(net: Net) -> torch.Tensor:
    (low,) = net.params["low"]
    low.data.copy_(torch.tensor([1.0, 2, 4, 1, 3, 9]).view(low.shape))
    net.forward_loss()[0].backward()
    assert low.grad is not None
    return low.grad


@pytest.mark.parametrize(("layer", "passes"), CASES, ids=[*IGNORE_IT, *HEED_IT])
def test_gradients_pass_layers_that_ignore_propagate_down(layer: str, passes: bool, net_of: Callable[..., Net]) -> None:
    text = TWO_READERS.format(layer=layer)
    found = gradient(net_of(text, TRAIN))
    everywhere = gradient(
        net_of(text.replace("propagate_down: false", "").replace("[false, false]", "[true, false]"), TRAIN)
    )
    assert torch.equal(found, everywhere if passes else torch.ones_like(found))
    assert not torch.equal(everywhere, torch.ones_like(found))


def test_no_gradient_reaches_a_layer_that_caffe_skips(net_of: Callable[..., Net]) -> None:
    """The only reader of its top has ``propagate_down: false``: Caffe does not run its backward pass."""
    text = TWO_READERS.format(layer=IGNORE_IT["Flatten"]).replace(
        'bottom: "low" top: "other"', 'bottom: "cont" top: "other"'
    )
    net = net_of(text, TRAIN)
    assert not net.forward_loss()[0].requires_grad
