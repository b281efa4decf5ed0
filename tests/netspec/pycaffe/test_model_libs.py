"""The parts of nets of SSD's scripts: names, shapes and numbers of weights are those of the known nets."""

import itertools
from pathlib import Path
from typing import Any

import pytest
import torch

from netspec.dialects import use_dialect
from netspec.net.build import build_net
from netspec.proto.text import parse_net_text
from netspec.pycaffe import model_libs
from netspec.pycaffe.model_libs import (
    ConvBNLayer,
    CreateAnnotatedDataLayer,
    CreateMultiBoxHead,
    InceptionV3Body,
    ResBody,
    ResNet101Body,
    ResNet152Body,
    UnpackVariable,
    VGGNetBody,
    ZFNetBody,
)
from netspec.pycaffe.net_spec import NetSpec
from netspec.pycaffe.net_spec import layers as L
from netspec.pycaffe.proto import caffe_pb2

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def ssd() -> None:
    use_dialect("ssd")


def image(size: int) -> NetSpec:
    n = NetSpec()
    n.data = L.Input(shape={"dim": [1, 3, size, size]})
    return n


def built(n: NetSpec) -> Any:
    return build_net(*parse_net_text(str(n.to_proto()), "made.prototxt"))


def weights(n: NetSpec) -> int:
    return sum(parameter.numel() for parameter in built(n).parameters())


def test_vgg() -> None:
    convolutions = 14_714_688  # of VGG's 16 layers
    assert weights(VGGNetBody(image(64), "data", need_fc=False)) == convolutions
    reduced = VGGNetBody(image(64), "data", fully_conv=True, reduced=True, dilated=True, dropout=False)
    assert weights(reduced) == convolutions + (512 * 9 + 1) * 1024 + (1024 + 1) * 1024
    layers = {layer.name: layer for layer in reduced.to_proto().layer}
    fc6 = layers["fc6"].convolution_param
    assert (fc6.kernel_size, fc6.dilation, fc6.pad) == ([3], [6], [6])
    pool5 = layers["pool5"].pooling_param
    assert (pool5.kernel_size, pool5.stride, pool5.pad) == (3, 1, 1)
    assert "drop6" not in layers


@pytest.mark.parametrize(
    "choice",
    [
        dict(zip(("fully_conv", "reduced", "dilated", "nopool", "dilate_pool4"), c, strict=True))
        for c in itertools.product((False, True), repeat=5)
    ],
)
def test_every_vgg_is_a_net(choice: dict[str, Any]) -> None:
    if choice["nopool"] and (choice["dilate_pool4"] or not choice["fully_conv"]):
        pytest.skip("SSD does not make it")
    layers = [layer.name for layer in VGGNetBody(image(64), "data", **choice).to_proto().layer]
    assert layers[-1] == "drop7"
    assert len(set(layers)) == len(layers)
    assert ("conv1_3" in layers, "pool1" in layers) == (choice["nopool"], not choice["nopool"])


def test_frozen_layers_do_not_learn() -> None:
    layers = {
        layer.name: layer for layer in VGGNetBody(image(64), "data", freeze_layers=["conv1_1", "x"]).to_proto().layer
    }
    assert [p.lr_mult for p in layers["conv1_1"].param] == [0, 0]
    assert [p.lr_mult for p in layers["conv1_2"].param] == [1, 2]


def test_zf() -> None:
    widths = (3, 96, 256, 384, 384, 256)
    kernels = (7, 5, 3, 3, 3)
    expected = sum((b * k * k + 1) * t for b, t, k in zip(widths, widths[1:], kernels, strict=False))
    assert weights(ZFNetBody(image(64), "data", need_fc=False)) == expected
    layers = [layer.name for layer in ZFNetBody(image(64), "data", need_fc8=True).to_proto().layer]
    assert layers[-6:] == ["drop6", "fc7", "relu7", "drop7", "fc8", "prob"]


def test_resnets() -> None:
    for body, learned in ((ResNet101Body, 42_500_160), (ResNet152Body, 58_143_808)):
        net = built(body(image(64), "data"))
        statistics = sum(2 * layer.blob_shapes[0][0] + 1 for layer in net.layers if layer.type == "BatchNorm")
        assert sum(p.numel() for p in net.parameters()) in (learned, learned + statistics)
    dilated = {
        layer.name: layer for layer in ResNet101Body(image(64), "data", use_dilation_conv5=True).to_proto().layer
    }
    assert dilated["res5a_branch2b"].convolution_param.dilation == [2]
    assert dilated["res5a_branch1"].convolution_param.stride == [1]


def test_inception() -> None:
    n = InceptionV3Body(image(299), "data", output_pred=True)
    layers = {layer.name: layer for layer in n.to_proto().layer}
    tall = layers["mixed_4/tower/conv_2"].convolution_param
    assert (tall.kernel_h, tall.kernel_w, tall.pad_h, tall.pad_w) == (7, 1, 3, 0)
    assert list(layers["mixed_10/join"].bottom) == [
        *("mixed_10/conv", "mixed_10/tower/mixed", "mixed_10/tower_1/mixed", "mixed_10/tower_2/conv")
    ]
    net = built(n)
    assert sum(layer.type == "Convolution" for layer in net.layers) == 94  # as in Inception v3 without its side branch


@pytest.mark.parametrize("frozen", [False, True])
def test_a_convolution_and_its_norm(frozen: bool) -> None:
    n = image(8)
    ConvBNLayer(
        n, "data", "c", True, True, 4, [1, 3], [0, 1], 1, use_scale=not frozen, use_global_stats=frozen, lr_mult=2
    )
    _, conv, norm, last, relu = n.to_proto().layer
    assert (conv.convolution_param.kernel_w, conv.convolution_param.pad_w) == (3, 1)
    assert not conv.convolution_param.bias_term
    assert [p.lr_mult for p in norm.param] == [0, 0, 0]
    assert norm.batch_norm_param.HasField("use_global_stats") == frozen
    assert (last.name, last.type) == (("c_bias", "Bias") if frozen else ("c_scale", "Scale"))
    assert {p.lr_mult for p in last.param} == {0 if frozen else 2}
    assert (relu.name, relu.top) == ("c_relu", ["c"])


def test_a_residual_block() -> None:
    n = image(8)
    ResBody(n, "data", "2a", 4, 4, 8, 2, True)
    names = [layer.name for layer in n.to_proto().layer]
    assert names[1:4] == ["res2a_branch1", "bn2a_branch1", "scale2a_branch1"]
    assert names[-2:] == ["res2a", "res2a_relu"]
    built(n)


def test_heads_on_two_maps() -> None:
    n = image(32)
    for name, stride in (("a", 4), ("b", 8)):
        n[name] = L.Convolution(n.data, num_output=6, kernel_size=1, stride=stride, weight_filler={"type": "xavier"})
    sizes: dict[str, Any] = {"min_sizes": [4.0, 8.0], "max_sizes": [[], 16.0], "aspect_ratios": [[2], [2, 3]]}
    tops = CreateMultiBoxHead(
        n, num_classes=3, from_layers=["a", "b"], normalizations=[20, -1], use_batchnorm=False, steps=[4, 8], **sizes
    )
    assert tops == [n.mbox_loc, n.mbox_conf, n.mbox_priorbox]
    boxes = 8 * 8 * 3 + 4 * 4 * 6
    net = built(n)
    out = net(data=torch.zeros(1, 3, 32, 32))
    assert tuple(out["mbox_loc"].shape) == (1, 4 * boxes)
    assert tuple(out["mbox_conf"].shape) == (1, 3 * boxes)
    assert tuple(out["mbox_priorbox"].shape) == (1, 2, 4 * boxes)
    assert n.a_norm_mbox_loc.fn.params["num_output"] == 12


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"num_classes": 0}, "must provide num_classes"),
        ({"min_sizes": []}, "from_layers and min_sizes should have same length"),
        ({"steps": [1, 2]}, "from_layers and steps should have same length"),
        ({"data_layer": "image"}, "data_layer is not in net's layers"),
    ],
)
def test_heads_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        CreateMultiBoxHead(image(8), **{"num_classes": 2, "from_layers": ["data"], "min_sizes": [3], **given})


def test_data_with_boxes_is_written() -> None:
    sampler = [{"sampler": {"min_scale": 0.3}, "sample_constraint": {"min_jaccard_overlap": 0.1}, "max_trials": 50}]
    resize = {"resize_param": {"height": 300, "width": 300, "interp_mode": [1, 2]}}
    n = NetSpec()
    n.data, n.label = CreateAnnotatedDataLayer(
        "lmdb", 8, label_map_file="map.prototxt", transform_param=resize, batch_sampler=sampler
    )
    (layer,) = n.to_proto().layer
    assert (layer.type, layer.top, layer.include[0].phase) == ("AnnotatedData", ["data", "label"], caffe_pb2.TRAIN)
    assert layer.annotated_data_param.batch_sampler[0].sampler.min_scale == pytest.approx(0.3)
    assert layer.transform_param.resize_param.height == 300


def test_small_helpers(tmp_path: Path) -> None:
    assert UnpackVariable([1, 2], 2) == [1, 2]
    assert UnpackVariable([1], 2) == UnpackVariable(1, 2) == [1, 1]
    model_libs.make_if_not_exist(str(tmp_path / "a" / "b"))
    assert model_libs.check_if_exist(str(tmp_path / "a" / "b"))
    names: dict[str, Any] = {}
    exec("from netspec.pycaffe.model_libs import *", names)
    assert {"L", "P", "caffe", "caffe_pb2", "os", "VGGNetBody"} <= set(names)
