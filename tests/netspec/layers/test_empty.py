"""Blobs without numbers, such as a batch of no detections: layers return what Caffe's loops over nothing leave."""

from collections.abc import Callable

import pytest
import torch

from netspec.net.net import Net
from netspec.proto.schema import TEST, TRAIN

LAYERS = {
    "Pooling": "pooling_param { kernel_size: 2 }",
    "AVE Pooling": "pooling_param { kernel_size: 2 pool: AVE }",
    "SPP": "spp_param { pyramid_height: 2 }",
    "Im2col": "convolution_param { kernel_size: 2 }",
    "Scale": "",
    "BatchNorm": "",
    "MVN": "",
    "LRN": "",
    "Softmax": "",
    "Reduction": "reduction_param { axis: 1 operation: MEAN }",
}


@pytest.mark.parametrize("shape", [(0, 3, 4, 4), (2, 0, 4, 4)])
@pytest.mark.parametrize("layer", LAYERS)
def test_layers_take_blobs_without_numbers(layer: str, shape: tuple[int, ...], net_of: Callable[..., Net]) -> None:
    dims = " ".join(f"dim: {size}" for size in shape)
    text = f"""
force_backward: true
layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ {dims} }} }} }}
layer {{ name: "it" type: "{layer.split()[-1]}" bottom: "x" top: "y" {LAYERS[layer]} }}
"""
    for phase in (TEST, TRAIN):
        net = net_of(text, phase)
        with torch.no_grad():
            assert net(x=torch.zeros(shape))["y"].shape == net.shapes["y"]
        top = net(x=torch.zeros(shape, requires_grad=True))["y"]
        assert top.shape == net.shapes["y"]
        if top.requires_grad:
            top.sum().backward()


@pytest.mark.parametrize("operation", ["SUM", "ASUM", "SUMSQ", "MEAN"])
def test_a_reduction_of_nothing(operation: str, net_of: Callable[..., Net]) -> None:
    """The mean is 0 / 0; the sums are 0."""
    net = net_of(f"""
layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: 2 dim: 0 }} }} }}
layer {{ name: "it" type: "Reduction" bottom: "x" top: "y" reduction_param {{ axis: 1 operation: {operation} }} }}
""")
    found = net(x=torch.zeros(2, 0))["y"]
    assert torch.equal(found.isnan(), torch.tensor([operation == "MEAN"] * 2))
    assert torch.equal(found.nan_to_num(), torch.zeros(2))
