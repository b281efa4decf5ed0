"""Folding: nets with BatchNorm, Scale, Dropout and Split folded give the same results with fewer layers."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import netspec
from exported import assert_same, here, random_inputs, trained
from netspec.export.formats.deploy import fold, with_inputs, write_caffe
from netspec.fast.fold import find_folds
from netspec.graph.options import BuildOptions
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.schema import TEST
from netspec.proto.text import parse_net, parse_net_text
from paths import GOLDEN

INPUT = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 4 dim: 5 dim: 5 } } }'
FILLERS = 'weight_filler { type: "gaussian" std: 0.5 } bias_filler { type: "uniform" min: -1 max: 1 }'
CONV = f"convolution_param {{ num_output: 6 kernel_size: 3 {FILLERS} }}"
NORM = """
layer {{ name: "bn{0}" type: "BatchNorm" bottom: "{0}" top: "{1}" }}
layer {{ name: "scale{0}" type: "Scale" bottom: "{1}" top: "{2}"
  scale_param {{ bias_term: true filler {{ type: "uniform" min: 0.5 max: 2 }} bias_filler {{ type: "uniform" }} }} }}
"""
TOWERS = """layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 4 dim: 5 dim: 5 } } }
layer { name: "p" type: "Input" top: "p" input_param { shape { dim: 2 dim: 4 dim: 5 dim: 5 } } }
layer { name: "conv" type: "Convolution" bottom: "data" top: "a" param { name: "w" } param { name: "b" }
  convolution_param { num_output: 6 kernel_size: 3
    weight_filler { type: "gaussian" std: 0.5 } bias_filler { type: "uniform" min: -1 max: 1 } } }
layer { name: "conv_p" type: "Convolution" bottom: "p" top: "x" param { name: "w" } param { name: "b" }
  convolution_param { num_output: 6 kernel_size: 3
    weight_filler { type: "gaussian" std: 0.5 } bias_filler { type: "uniform" min: -1 max: 1 } } }
layer { name: "bn" type: "BatchNorm" bottom: "a" top: "y"
  param { name: "m" lr_mult: 0 } param { name: "v" lr_mult: 0 } param { name: "n" lr_mult: 0 } }
layer { name: "bn_p" type: "BatchNorm" bottom: "x" top: "z" {shared} }
"""


def folded(net: Net, folder: Path) -> Net:
    """Return the folded net, written to files and read from them."""
    prototxt, weights = write_caffe(fold(net), folder / "folded")
    return netspec.load_net(prototxt, weights=weights)


def types(net: Net) -> list[str]:
    return [layer.type for layer in net.layers]


@pytest.mark.parametrize(
    "layer",
    [
        f'type: "Convolution" {CONV}',
        'type: "Convolution" convolution_param { num_output: 6 group: 2 dilation: 2 kernel_size: 2 bias_term: false '
        f"{FILLERS} }}",
        f'type: "Deconvolution" convolution_param {{ num_output: 6 group: 2 kernel_size: 3 stride: 2 {FILLERS} }}',
        f'type: "InnerProduct" inner_product_param {{ num_output: 6 {FILLERS} }}',
        f'type: "InnerProduct" inner_product_param {{ num_output: 6 transpose: true {FILLERS} }}',
    ],
    ids=["convolution", "grouped, dilated, without bias", "deconvolution", "inner product", "transposed"],
)
@pytest.mark.parametrize("tops", ["abc", "aaa"], ids=["own tops", "in place"])
def test_batch_norm_and_scale_become_part_of_the_weights(
    layer: str, tops: str, net_of: Callable[..., Net], tmp_path: Path
) -> None:
    text = f'{INPUT} layer {{ name: "conv" bottom: "data" top: "a" {layer} }}' + NORM.format(*tops)
    text += f'layer {{ name: "relu" type: "ReLU" bottom: "{tops[2]}" top: "{tops[2]}" }}'
    net = trained(net_of(text))
    small = folded(net, tmp_path)
    assert len(small.layers) == 3
    assert_same(here(small, random_inputs(net)), here(net, random_inputs(net)))


def test_a_blob_that_another_layer_reads_is_kept(net_of: Callable[..., Net], tmp_path: Path) -> None:
    text = f'{INPUT} layer {{ name: "conv" type: "Convolution" bottom: "data" top: "a" {CONV} }}' + NORM.format(*"abc")
    net = trained(net_of(text + 'layer { name: "sum" type: "Eltwise" bottom: "a" bottom: "c" top: "sum" }'))
    small = folded(net, tmp_path)
    assert types(small) == ["Input", "Convolution", "Split", "Scale", "Eltwise"]  # BatchNorm is in the Scale
    assert_same(here(small, random_inputs(net)), here(net, random_inputs(net)))


def test_dropout_and_split_are_removed_and_outputs_keep_their_names(net_of: Callable[..., Net], tmp_path: Path) -> None:
    text = f"""{INPUT}
    layer {{ name: "conv" type: "Convolution" bottom: "data" top: "a" {CONV} }}
    layer {{ name: "drop" type: "Dropout" bottom: "a" top: "b" }}
    layer {{ name: "copies" type: "Split" bottom: "b" top: "c" top: "d" }}
    layer {{ name: "relu" type: "ReLU" bottom: "c" top: "c" }}
    layer {{ name: "out" type: "Dropout" bottom: "d" top: "out" }}
    layer {{ name: "absval" type: "AbsVal" bottom: "c" top: "e" }}
    layer {{ name: "last" type: "Dropout" bottom: "e" top: "last" }}"""
    net = net_of(text)
    small = fold(net)
    assert [layer.name for layer in small.layer] == ["data", "conv", "relu", "out", "absval"]
    again = folded(net, tmp_path)
    assert again.outputs == net.outputs == ["last", "out"]
    assert_same(here(again, random_inputs(net)), here(net, random_inputs(net)))


def test_all_outputs_of_a_split_stay(net_of: Callable[..., Net], tmp_path: Path) -> None:
    net = net_of(f"""{INPUT} layer {{ name: "relu" type: "ReLU" bottom: "data" top: "a" }}
    layer {{ name: "copies" type: "Split" bottom: "a" top: "b" top: "c" }}""")
    small = folded(net, tmp_path)
    assert small.outputs == net.outputs == ["b", "c"]
    assert_same(here(small, random_inputs(net)), here(net, random_inputs(net)))


SHARED = 'param { name: "m" lr_mult: 0 } param { name: "v" lr_mult: 0 } param { name: "n" lr_mult: 0 }'


@pytest.mark.parametrize("shared", [SHARED, ""], ids=["with shared statistics", "each with its own"])
def test_towers_share_folded_weights_if_they_share_statistics(
    shared: str, net_of: Callable[..., Net], tmp_path: Path
) -> None:
    net = trained(net_of(TOWERS.replace("{shared}", shared)))
    small = folded(net, tmp_path)
    assert types(small) == ["Input", "Input", "Convolution", "Convolution"]
    assert (small.params["conv"][0] is small.params["conv_p"][0]) == bool(shared)
    assert_same(here(small, random_inputs(net)), here(net, random_inputs(net)))


def test_folding_is_in_double_precision(net_of: Callable[..., Net]) -> None:
    text = f'{INPUT} layer {{ name: "conv" type: "Convolution" bottom: "data" top: "a" {CONV} }}' + NORM.format(*"abc")
    net = trained(net_of(text))
    (found,) = find_folds(net.plan, list(net.layers))
    assert found.chain.keeper == 1
    assert found.chain.folded == (2, 3)
    weights, bias = found.absorbed.blobs
    exact = net.double()
    expected = here(exact, {"data": random_inputs(exact)["data"].astype(np.float64)})["c"]
    data = torch.from_numpy(random_inputs(exact)["data"]).double()
    found_top = torch.nn.functional.conv2d(data, weights, bias)
    np.testing.assert_allclose(found_top.numpy(), expected, rtol=1e-12, atol=1e-12)


def test_a_training_net_becomes_a_deploy_net(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(GOLDEN / "train" / "sgd_step")
    monkeypatch.chdir(GOLDEN)
    message, source = parse_net("train/sgd_step/train_val.prototxt")
    message.state.phase = TEST
    deploy, source = with_inputs(
        message, source, BuildOptions(given_shapes={"pair_data": (4, 2, 28, 28)}), labels=False
    )
    net = build_net(deploy, source)
    assert net.inputs == ["pair_data"]
    assert not any(layer.is_loss for layer in net.layers)
    assert net.outputs


def test_a_data_layer_with_the_name_of_another_layer_becomes_an_input() -> None:
    text = """layer { name: "d" type: "MemoryData" top: "x" top: "t"
      memory_data_param { batch_size: 1 channels: 1 height: 1 width: 2 } }
    layer { name: "d" type: "InnerProduct" bottom: "x" top: "y" inner_product_param { num_output: 1 } }"""
    message, source = parse_net_text(text, "net.prototxt")
    deploy, _ = with_inputs(message, source, BuildOptions(), labels=False)
    assert [layer.type for layer in deploy.layer] == ["Input", "InnerProduct"]


CASES = [
    case
    for case in sorted((GOLDEN / "layers").iterdir())
    if any(word in case.name for word in ("batchnorm", "scale", "residual", "split", "dropout", "siamese", "v1"))
]


@pytest.mark.parametrize("case", CASES, ids=lambda path: path.name)
def test_folded_golden_nets_compute_the_same(case: Path, tmp_path: Path) -> None:
    net = netspec.load_net(case / "net.prototxt", phase="TEST")
    small = folded(trained(net), tmp_path)
    assert_same(here(small, random_inputs(net)), here(net, random_inputs(net)))
