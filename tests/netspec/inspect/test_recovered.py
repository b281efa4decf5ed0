"""The deploy net that is read from a .caffemodel, for weights whose prototxt is lost."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lmdb
import numpy as np
import pytest
import torch

import netspec
from netspec.errors import SpecError
from netspec.inspect.recovered import recover_net
from netspec.net.weights import net_to_proto
from netspec.proto.binary import is_net_binary
from netspec.proto.schema import BlobProto, Datum, LayerParameter, NetParameter, V1LayerParameter
from netspec.proto.text import write_text
from paths import GOLDEN

TRAINED = """
name: "classifier"
layer { name: "d" type: "Data" top: "data" top: "label" include { phase: TRAIN }
  transform_param { %s scale: 0.5 } data_param { source: "gone" batch_size: 8 backend: LMDB } }
layer { name: "conv" type: "Convolution" bottom: "data" top: "conv" convolution_param { num_output: 4 kernel_size: 3 } }
layer { name: "relu" type: "ReLU" bottom: "conv" top: "relu" }
layer { name: "both" type: "Eltwise" bottom: "conv" bottom: "relu" top: "both" }
layer { name: "in" type: "ReLU" bottom: "both" top: "both" }
layer { name: "ip" type: "InnerProduct" bottom: "both" top: "ip" inner_product_param { num_output: 3 } }
layer { name: "loss" type: "SoftmaxWithLoss" bottom: "ip" bottom: "label" top: "loss" }
"""
SHAPE = {"data": (8, 3, 9, 9)}


@pytest.fixture
def trained(net_of: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Any]:
    """Return a function that writes w.caffemodel as a training does, and returns its net."""
    monkeypatch.chdir(tmp_path)

    def write(transform: str = "crop_size: 9") -> Any:
        net = net_of(TRAINED % transform, 0, open_data=False, given_shapes=SHAPE)
        Path("w.caffemodel").write_bytes(net_to_proto(net).SerializeToString())
        return net

    return write


def test_the_deploy_net_of_a_training_computes_the_same(trained: Callable[..., Any], warnings: Callable[[], list[str]]):
    net = trained()
    deploy, _ = recover_net("w.caffemodel", {})
    assert [layer.name for layer in deploy.layer] == ["data", "conv", "relu", "both", "in", "ip"]
    assert list(deploy.layer[0].input_param.shape[0].dim) == [1, 3, 9, 9]
    assert [list(layer.bottom) for layer in deploy.layer[2:5]] == [["conv"], ["conv", "relu"], ["both"]]
    assert not any(layer.blobs or layer.include or layer.HasField("phase") for layer in deploy.layer)
    assert warnings() == [
        'the net was trained with transform_param { scale: 0.5 crop_size: 9 } for blob "data"',
        "w.caffemodel: left out, since --shape does not give label: loss",
    ]
    Path("deploy.prototxt").write_text(write_text(deploy))
    built = netspec.load_net("deploy.prototxt", weights="w.caffemodel", strict=True)
    image = np.random.default_rng(0).random((1, 3, 9, 9), np.float32)
    layers = {layer.param.name: layer for layer in net.layers}
    (conv,) = layers["conv"].run(torch.from_numpy(image))
    (ip,) = layers["ip"].run(torch.relu(conv + torch.relu(conv)))
    torch.testing.assert_close(built(data=image)["ip"], ip)


def test_an_unknown_shape_is_refused_with_the_option_to_give(trained: Callable[..., Any]):
    trained("mirror: true")
    with pytest.raises(SpecError, match=r"w\.caffemodel: the shape of its input .*; give --shape data=1,3,H,W or"):
        recover_net("w.caffemodel", {})
    with pytest.raises(SpecError, match=r'--shape names "date"; did you mean "data"\? inputs of this net: data, label'):
        recover_net("w.caffemodel", {"date": (1, 3, 9, 9)})
    deploy, _ = recover_net("w.caffemodel", {"data": (2, 3, 7, 7), "label": (2,)})
    assert deploy.layer[-1].type == "SoftmaxWithLoss"


def test_the_input_shape_is_read_from_the_database_of_the_training(trained: Callable[..., Any]):
    trained("mirror: true")
    shutil.copytree(GOLDEN / "images" / "lmdb_plain", "gone")
    deploy, _ = recover_net("w.caffemodel", {})
    with lmdb.open("gone", readonly=True, lock=False) as records, records.begin() as reading:
        datum = Datum.FromString(next(iter(reading.cursor()))[1])
    assert list(deploy.layer[0].input_param.shape[0].dim) == [1, datum.channels, datum.height, datum.width]
    assert deploy.layer[-1].name == "ip"
    Path("gone/data.mdb").write_bytes(b"")
    with pytest.raises(SpecError, match='in the file, and "gone", which it was trained on, cannot be read here; give'):
        recover_net("w.caffemodel", {})


@pytest.mark.slow
def test_check_and_upgrade_net_proto_text_read_the_net_of_a_caffemodel(
    trained: Callable[..., Any], run: Callable[..., Any]
):
    trained("mirror: true")
    assert "give --shape data=1,3,H,W" in run("check", "w.caffemodel").fault
    result = run("check", "w.caffemodel", "--shape", "data=1,3,9,9")
    assert result.status == 0
    assert "classifier" in result.out
    assert "1x4x7x7" in result.out
    assert run("upgrade_net_proto_text", "w.caffemodel", "o.prototxt", "--shape", "data=1,3,9,9").status == 0
    assert run("check", "o.prototxt", "--weights", "w.caffemodel", "--strict").status == 0
    assert run("upgrade_net_proto_text", "o.prototxt", "p.prototxt", "--shape", "data=1,3,9,9").status == 2


def test_inputs_of_old_nets_are_the_blobs_without_a_layer(tmp_path: Path):
    net = NetParameter(name="old", input=["data"])
    layer = V1LayerParameter(name="c", type=V1LayerParameter.CONVOLUTION, bottom=["data"], top=["c"])
    layer.convolution_param.num_output = 2
    layer.convolution_param.kernel_size.append(1)
    layer.blobs.add(num=2, channels=3, height=1, width=1).data.extend(range(6))
    net.layers.append(layer)
    path = tmp_path / "old.caffemodel"
    path.write_bytes(net.SerializeToString())
    with pytest.raises(SpecError, match="give --shape data=1,3,H,W"):
        recover_net(path, {})
    deploy, _ = recover_net(path, {"data": (1, 3, 5, 5)})
    assert [layer.type for layer in deploy.layer] == ["Input", "Convolution"]


def test_files_without_a_net_are_refused(tmp_path: Path):
    path = tmp_path / "w.caffemodel"
    path.write_bytes(NetParameter(layer=[LayerParameter(name="c", blobs=[BlobProto(data=[0.0])])]).SerializeToString())
    with pytest.raises(SpecError, match="contains weights but no net"):
        recover_net(path, {})
    path.write_text('layer { name: "c" }')
    assert not is_net_binary(path)
    assert not is_net_binary(tmp_path / "nowhere")
