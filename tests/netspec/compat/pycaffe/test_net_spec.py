"""Nets written in Python. Caffe: python/caffe/test/test_net_spec.py and what scripts do beyond it."""

import copy
from typing import Any

import numpy as np
import pytest

from netspec import use_dialect
from netspec.compat.pycaffe.net_spec import NetSpec, to_proto
from netspec.compat.pycaffe.net_spec import layers as L
from netspec.compat.pycaffe.net_spec import params as P
from netspec.compat.pycaffe.proto import caffe_pb2
from netspec.net.build import build_net
from netspec.proto.text import parse_net_text


def lenet() -> NetSpec:
    n = NetSpec()
    shapes = [{"dim": [4, 1, 28, 28]}, {"dim": [4, 1, 1, 1]}]
    n.data, n.label = L.DummyData(shape=shapes, transform_param={"scale": 1 / 255}, ntop=2)
    n.conv1 = L.Convolution(n.data, kernel_size=5, num_output=20, weight_filler={"type": "xavier"})
    n.pool1 = L.Pooling(n.conv1, kernel_size=2, stride=2, pool=P.Pooling.MAX)
    n.ip1 = L.InnerProduct(n.pool1, num_output=50, weight_filler={"type": "xavier"})
    n.relu1 = L.ReLU(n.ip1, in_place=True)
    n.ip2 = L.InnerProduct(n.relu1, num_output=10, weight_filler={"type": "xavier"})
    n.loss = L.SoftmaxWithLoss(n.ip2, n.label)
    return n


def built(proto: Any) -> Any:
    return build_net(*parse_net_text(str(proto), "made.prototxt"))


def test_attributes_name_blobs_and_layers() -> None:
    proto = lenet().to_proto()
    assert [layer.name for layer in proto.layer] == ["data", "conv1", "pool1", "ip1", "relu1", "ip2", "loss"]
    assert proto.layer[0].top == ["data", "label"]
    assert proto.layer[4].bottom == proto.layer[4].top == ["ip1"]  # in place
    assert proto.layer[5].bottom == ["ip1"]
    assert len(built(proto).layers) == 7


def test_without_names_layers_are_numbered_by_type() -> None:
    data, label = L.DummyData(shape=[{"dim": [4, 8]}, {"dim": [4]}], ntop=2)
    first = L.ReLU(L.InnerProduct(data, num_output=5, weight_filler={"type": "xavier"}), in_place=True)
    loss = L.SoftmaxWithLoss(L.InnerProduct(first, num_output=3, weight_filler={"type": "xavier"}), label)
    proto = loss.to_proto()
    assert [layer.name for layer in proto.layer] == [
        "DummyData1",
        "InnerProduct1",
        "ReLU1",
        "InnerProduct2",
        "SoftmaxWithLoss1",
    ]
    assert proto.layer[0].top == ["DummyData1", "DummyData2"]
    assert proto == to_proto(loss)
    assert len(built(proto).layers) == 5


def test_several_tops_give_the_layers_of_all() -> None:
    data = L.Input(shape={"dim": [1, 2]})
    proto = to_proto(L.ReLU(data), L.Sigmoid(data))
    assert [layer.name for layer in proto.layer] == ["Input1", "ReLU1", "Sigmoid1"]


def test_layers_without_tops() -> None:
    n = NetSpec()
    n.data, n.data2 = L.DummyData(shape={"dim": 3}, ntop=2)
    n.silence = L.Silence(n.data, ntop=0)
    n.silence2 = L.Silence(n.data2, ntop=0)
    proto = n.to_proto()
    assert [layer.name for layer in proto.layer] == ["data", "silence", "silence2"]
    assert len(built(proto)()) == 0


def test_an_input_that_is_not_a_top_is_a_type_error() -> None:
    data = L.DummyData(ntop=2)
    with pytest.raises(TypeError, match=r"^Silence input 0 is not a Top \(type is <class 'tuple'>\)$"):
        L.Silence(data, ntop=0)
    assert L.Silence(*data, ntop=0).ntop == 0


def test_a_tuple_of_tops_as_an_attribute_is_a_type_error() -> None:
    n = NetSpec()
    n.both = L.DummyData(ntop=2)
    with pytest.raises(TypeError, match="a layer with ntop=2 gives a tuple"):
        n.to_proto()


def test_required_layers_are_added_before_their_readers() -> None:
    n = NetSpec()
    n.top = L.ReLU(L.Power(L.Input(shape={"dim": [1, 1]}), scale=2))
    assert [layer.name for layer in n.to_proto().layer] == ["Input1", "Power1", "top"]


def test_parameters_are_assigned_to_the_right_message() -> None:
    data = L.Input(shape={"dim": [1, 1, 8, 8]})
    options: dict[str, Any] = {
        "param": [{"lr_mult": 1, "decay_mult": 1}, {"lr_mult": 2}],
        "include": {"phase": caffe_pb2.TEST, "stage": ["a", "b"]},
        "loss_weight": 2,
        "name": "own",
        "convolution_param": {"group": 1},
    }
    top = L.Convolution(
        data, num_output=np.int64(3), kernel_size=(3, 5), bias_filler={"value": np.float32(0.5)}, **options
    )
    layer = top.to_proto().layer[1]
    assert layer.convolution_param.num_output == 3
    assert layer.convolution_param.kernel_size == [3, 5]
    assert layer.convolution_param.group == 1
    assert layer.convolution_param.bias_filler.value == 0.5
    assert [p.lr_mult for p in layer.param] == [1, 2]
    assert layer.include[0].phase == caffe_pb2.TEST
    assert layer.include[0].stage == ["a", "b"]
    assert layer.loss_weight == [2]
    assert (layer.name, layer.top) == ("own", ["Convolution1"])


def test_enums_can_be_names_and_messages_can_be_objects() -> None:
    data = L.Input(input_param=caffe_pb2.InputParameter(shape=[caffe_pb2.BlobShape(dim=[1, 2, 4, 4])]))
    proto = L.Pooling(data, pool="AVE", kernel_size=2).to_proto()
    assert proto.layer[0].input_param.shape[0].dim == [1, 2, 4, 4]
    assert proto.layer[1].pooling_param.pool == P.Pooling.AVE


def test_a_python_layer() -> None:
    data = L.Python(module="digits", layer="Digits", ntop=1, param_str=str({"seed": 1}))
    param = data.to_proto().layer[0].python_param
    assert (param.module, param.layer, param.param_str) == ("digits", "Digits", "{'seed': 1}")


def test_an_unknown_parameter_is_an_attribute_error_with_the_nearest() -> None:
    with pytest.raises(AttributeError, match=r'"Convolution": .* no field "kernal_size"; did you mean "kernel_size"\?'):
        L.Convolution(L.Input(), kernal_size=3).to_proto()
    with pytest.raises(AttributeError, match='"Deconvolution": LayerParameter has no field "kernel_size"'):
        L.Deconvolution(L.Input(), kernel_size=3).to_proto()  # as in Caffe, whose message for it is convolution_param


def test_a_value_of_the_wrong_type_is_a_type_error() -> None:
    with pytest.raises(TypeError):
        L.InnerProduct(L.Input(), num_output="many").to_proto()


def test_a_missing_top_is_a_key_error_and_an_attribute_error() -> None:
    n = lenet()
    with pytest.raises(KeyError, match='did you mean "conv1"'):
        _ = n["conv2"]
    assert not hasattr(n, "conv2")
    assert getattr(n, "conv2", None) is None


def test_items_attributes_and_ssds_methods() -> None:
    n = NetSpec()
    n["a/b"] = L.Input(shape={"dim": [1, 1]})
    n.c = L.ReLU(n["a/b"])
    assert list(n.tops) == n.keys() == ["a/b", "c"]
    assert n.vals() == [n["a/b"], n.c]
    n.update("c", {"negative_slope": 0.5})
    assert n.to_proto().layer[1].relu_param.negative_slope == 0.5
    del n.c
    assert n.keys() == ["a/b"]


def test_a_spec_is_copied() -> None:
    n = lenet()
    assert copy.deepcopy(n).to_proto() == n.to_proto()


@pytest.mark.slow
def test_a_deep_net_does_not_exceed_the_recursion_limit() -> None:
    top = L.Input(shape={"dim": [1, 1]})
    for _ in range(3000):
        top = L.ReLU(top)
    assert len(top.to_proto().layer) == 3001


def test_a_dialects_layers_and_constants() -> None:
    use_dialect("ssd")
    top = L.Permute(L.Input(shape={"dim": [1, 3, 8, 8]}), order=[0, 2, 3, 1])
    assert top.to_proto().layer[1].permute_param.order == [0, 2, 3, 1]
    assert P.PriorBox.CENTER_SIZE == 2
    assert L.Normalize(top, norm_param={"eps": 1}).to_proto().layer[2].norm_param.eps == 1
    found = L.DetectionOutput(top, top, top, nms_param={"top_k": 4}).to_proto().layer[-1]
    assert found.detection_output_param.nms_param.top_k == 4
