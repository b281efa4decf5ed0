"""``net.to(device)``: the net goes there whole. The device meta stands for a GPU."""

from collections.abc import Callable

import pytest
import torch

from netspec.net.net import Net
from netspec.proto.schema import TEST, TRAIN

TEXT = """
layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 2 dim: 3 } } }
layer { name: "d" type: "DummyData" top: "d" dummy_data_param { shape { dim: 2 dim: 4 } } }
layer { name: "ip" type: "InnerProduct" bottom: "x" top: "y"
  inner_product_param { num_output: 4 weight_filler { type: "xavier" } } }
layer { name: "sum" type: "Eltwise" bottom: "y" bottom: "d" top: "sum" }
"""


@pytest.mark.parametrize("phase", [TRAIN, TEST])
def test_inputs_constants_and_outputs_follow_the_parameters(phase: int, net_of: Callable[..., Net]) -> None:
    net = net_of(TEXT, phase)
    with torch.no_grad():
        net(x=torch.zeros(2, 3))
    assert net.to("meta") is net
    net.keep = "all"
    for recorded in (True, False):
        with torch.set_grad_enabled(recorded):
            net(x=torch.zeros(2, 3))
        assert {blob.device.type for blob in net.blobs.values()} == {"meta"}
    assert net.device == torch.device("meta")


def test_the_precision_changes_without_a_move(net_of: Callable[..., Net]) -> None:
    net = net_of(TEXT).double()
    assert net.device == torch.device("cpu")
    assert net(x=torch.zeros(2, 3))["sum"].dtype == torch.float64
    assert net.cpu() is net
