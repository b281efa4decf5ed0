"""A dialect belongs to the nets that use it: others in the same process have Caffe's own layers."""

from collections.abc import Callable

import torch

from netspec.dialects import use_dialect
from netspec.layers.vision.convolution import Convolution
from netspec.net.net import Net

PLAIN = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 1 dim: 9 dim: 9 } } }
layer { name: "conv" type: "Convolution" bottom: "data" top: "conv" convolution_param { num_output: 2 kernel_size: 3 } }
"""
FORK = PLAIN.replace("kernel_size: 3", "kernel_size: 3 hole: 2")


def test_a_layer_in_place_of_caffes_is_for_nets_of_its_dialect(net_of: Callable[..., Net]) -> None:
    fork, plain = net_of(FORK), net_of(PLAIN)
    assert type(plain.layers[1]) is Convolution
    assert type(fork.layers[1]).__module__ == "netspec.dialects.blocks.filters"
    assert (fork.options.dialects, plain.options.dialects) == (("filters",), ())
    values = torch.randn(1, 1, 9, 9)
    assert fork(values)["conv"].shape == (1, 2, 5, 5)
    assert plain(values)["conv"].shape == (1, 2, 7, 7)


def test_a_dialect_that_was_asked_for_counts_for_every_net(net_of: Callable[..., Net]) -> None:
    use_dialect("filters")
    assert net_of(PLAIN).options.dialects == ("filters",)
    assert net_of(PLAIN.replace('"conv"', '"other"')).layers[1].__class__ is not Convolution


def test_a_layer_type_names_its_dialect(net_of: Callable[..., Net]) -> None:
    swish = 'layer { name: "swish" type: "Normalize" bottom: "data" top: "n" }'
    assert net_of(PLAIN + swish).options.dialects == ("ssd",)
