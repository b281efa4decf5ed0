"""Prepared nets with layers of dialects give the same results as before they are prepared."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from netspec.fast.layers.dialects import ENTRIES
from netspec.net.net import Net
from paths import ROOT

BITS = "bw_layer_in: 6 fl_layer_in: 3 bw_layer_out: 8 fl_layer_out: 2 bw_params: 5 fl_params: 4"
CONV = "convolution_param { num_output: 4 kernel_size: 3 weight_filler { type: 'xavier' } %s }"
LAYERS = {
    "sides": f"type: 'Convolution' {CONV % 'pad_l: 2 pad_b: 1'}",
    "holes": f"type: 'Convolution' {CONV % 'hole: 2'}",
    "slopes": "type: 'BatchNorm' batch_norm_param { scale_bias: true scale_filler { type: 'uniform' min: 2 max: 3 } }",
    "bits": f"type: 'ConvolutionRistretto' {CONV % ''} quantization_param {{ {BITS} }}",
    "bits of vectors": "type: 'FcRistretto' inner_product_param { num_output: 4 weight_filler { type: 'xavier' } }"
    f" quantization_param {{ {BITS} }}",
}


@pytest.mark.parametrize("path", ENTRIES)
def test_each_entry_names_an_existing_class(path: str) -> None:
    module, _, name = path.rpartition(".")
    assert f"class {name}(" in (ROOT / f"{module.replace('.', '/')}.py").read_text()


@pytest.mark.parametrize("layer", LAYERS)
def test_a_prepared_net_gives_the_same_results(layer: str, net_of: Callable[..., Net]) -> None:
    text = f"""layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: 2 dim: 3 dim: 9 dim: 8 }} }} }}
        layer {{ name: "it" {LAYERS[layer]} bottom: "x" top: "y" }}
        layer {{ name: "relu" type: "ReLU" bottom: "y" top: "y" }}"""
    net = net_of(text)
    for blob in net.params["it"][:3] if layer == "slopes" else ():
        with torch.no_grad():
            blob.uniform_(0.5, 1)
    data = torch.randn(2, 3, 9, 8)
    expected = net(x=data)["y"]
    with torch.inference_mode():
        for _ in range(4):
            np.testing.assert_allclose(net(x=data)["y"], expected.detach(), rtol=1e-5, atol=1e-6)
