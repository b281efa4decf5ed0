"""caffe.Net: the checks of Caffe's test_net.py, on other nets."""

from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import pytest

import netspec.pycaffe as caffe
from pycaffe_nets import CLASSES, SMALL


@pytest.fixture
def net(net_of: Callable[..., caffe.Net]) -> caffe.Net:
    net = net_of(SMALL, caffe.TRAIN)
    net.blobs["label"].data[...] = np.random.default_rng(0).integers(CLASSES, size=4)
    return net


@pytest.mark.slow
def test_memory_outlives_the_net(net: caffe.Net) -> None:
    net.forward()
    net.backward()
    params = [blob for blobs in net.params.values() for blob in blobs]
    blobs = list(net.blobs.values())
    del net
    for blob in params + blobs:
        assert np.isfinite(blob.data.sum() + blob.diff.sum())


def test_layers_by_name(net: caffe.Net) -> None:
    assert list(net.layer_dict) == list(net._layer_names) == ["numbers", "filters", "scores", "cost"]
    assert [net.layer_dict[name].type for name in net._layer_names] == [layer.type for layer in net.layers]
    assert net.layers[1].type == "Convolution"
    assert isinstance(net.layers[1], caffe.Layer)
    assert net.layers[1].blobs is net.params["filters"]


def test_forward_from_a_layer_to_a_layer_reads_memory(net: caffe.Net) -> None:
    maps = np.random.default_rng(1).random(net.blobs["maps"].data.shape, np.float32)
    net.blobs["maps"].data[:] = maps
    outputs = net.forward(start="scores", end="scores")
    assert list(outputs) == ["score"]
    weight, bias = (blob.data for blob in net.params["scores"])
    np.testing.assert_allclose(outputs["score"], maps.reshape(4, -1) @ weight.T + bias, rtol=1e-4, atol=1e-5)
    assert (net.blobs["maps"].data == maps).all()


def test_backward_from_a_layer_to_a_layer_reads_memory(net: caffe.Net) -> None:
    diff = np.random.default_rng(1).random(net.blobs["score"].shape, np.float32)
    net.blobs["score"].diff[:] = diff
    outputs = net.backward(start="scores", end="scores")
    assert list(outputs) == ["maps"]
    expected = (diff @ net.params["scores"][0].data).reshape(net.blobs["maps"].shape)
    np.testing.assert_allclose(net.blobs["maps"].diff, expected, rtol=1e-4, atol=1e-6)


def test_diffs_of_parameters_add_up_until_they_are_cleared(net: caffe.Net) -> None:
    net.forward()
    net.backward()
    diff = net.params["filters"][0].diff
    once = diff.copy()
    assert np.abs(once).max() > 0
    net.backward()
    np.testing.assert_allclose(diff, 2 * once, rtol=1e-5, atol=1e-6)
    net.clear_param_diffs()
    assert (diff == 0).all()


def test_names(net: caffe.Net) -> None:
    assert net.inputs == []
    assert net.outputs == ["cost"]
    tops = [("numbers", ["data", "label"]), ("filters", ["maps"]), ("scores", ["score"]), ("cost", ["cost"])]
    bottoms = [("numbers", []), ("filters", ["data"]), ("scores", ["maps"]), ("cost", ["score", "label"])]
    assert net.top_names == OrderedDict(tops)
    assert net.bottom_names == OrderedDict(bottoms)
    assert net._blob_names == ["data", "label", "maps", "score", "cost"]
    assert list(net.blob_loss_weights.items())[-2:] == [("score", 0), ("cost", 1)]


def test_weights_are_saved_and_read(net: caffe.Net, caplog: pytest.LogCaptureFixture) -> None:
    net.save("small.caffemodel")
    net.save_hdf5("small.h5")
    other = caffe.Net("net.prototxt", caffe.TRAIN)
    other.load_hdf5("small.h5")
    older = caffe.Net("net.prototxt", "small.caffemodel", caffe.TRAIN)
    assert "Net('net.prototxt', 0, weights='small.caffemodel')" in caplog.text
    newer = caffe.Net("net.prototxt", caffe.TRAIN, weights="small.caffemodel")
    for again in (other, older, newer):
        for name, blobs in net.params.items():
            for mine, theirs in zip(blobs, again.params[name], strict=True):
                assert (mine.data == theirs.data).all()


def ruled(name: str, rule: str) -> str:
    return f"""
    layer {{ name: "{name}" type: "InnerProduct" bottom: "data" top: "{name}" {rule}
      inner_product_param {{ num_output: 1 }} }}"""


def blobs_made(net: caffe.Net) -> list[str]:
    """Return the blobs besides the input and its copies."""
    return [name for name in net.blobs if "data" not in name]


@pytest.mark.parametrize(
    ("level", "expected"),
    [
        (None, ["always", "up to 0", "from 0"]),
        (1, ["always", "from 0", "from 1"]),
        (2, ["always", "from 0", "from 1"]),
        (-1, ["always", "up to 0"]),
    ],
)
def test_levels(write: Callable[..., str], level: int | None, expected: list[str]) -> None:
    path = write(
        'input: "data" input_shape { dim: 1 dim: 1 dim: 10 dim: 10 }'
        + ruled("always", "")
        + ruled("up to 0", "include { max_level: 0 }")
        + ruled("from 0", "include { min_level: 0 }")
        + ruled("from 1", "include { min_level: 1 }")
    )
    net = caffe.Net(path, caffe.TEST) if level is None else caffe.Net(path, caffe.TEST, level=level)
    assert blobs_made(net) == expected
    if level is not None:
        assert blobs_made(caffe.Net(path, caffe.TEST, level)) == expected


def test_train_test_and_deploy_in_one_file(write: Callable[..., str]) -> None:
    shape = "shape { dim: 1 dim: 1 dim: 10 dim: 10 }"
    data = f'type: "DummyData" top: "data" top: "label" dummy_data_param {{ {shape} shape {{ dim: 1 dim: 1 }} }}'
    path = write(
        f'layer {{ name: "train" {data} include {{ phase: TRAIN }} }}\n'
        f'layer {{ name: "val" {data} include {{ phase: TEST stage: "val" }} }}\n'
        f'layer {{ name: "given" type: "Input" top: "data" input_param {{ {shape} }} include {{ stage: "deploy" }} }}\n'
        'layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip" inner_product_param { num_output: 2 } }\n'
        'layer { name: "loss" type: "SoftmaxWithLoss" bottom: "ip" bottom: "label" top: "loss"\n'
        '  include { phase: TRAIN } include { phase: TEST stage: "val" } }\n'
        'layer { name: "pred" type: "Softmax" bottom: "ip" top: "pred" include { stage: "deploy" } }\n'
    )
    for phase, stages, outputs in (
        (caffe.TRAIN, None, ["loss"]),
        (caffe.TEST, ["val"], ["loss"]),
        (caffe.TEST, ["deploy"], ["pred"]),
    ):
        net = caffe.Net(path, phase, stages=stages)
        assert list(net.blobs["data"].shape) == [1, 1, 10, 10]
        assert net.outputs == outputs
        assert list(net.forward()) == outputs
    assert net.inputs == ["data"]
    assert blobs_made(net) == ["ip", "pred"]


def test_a_loss_without_a_top_has_an_automatic_one(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(SMALL.replace('top: "cost"', ""), caffe.TRAIN)
    assert net._blob_names[-1] == "(automatic)"
    assert net.top_names["cost"] == ["(automatic)"]
    net.blobs["label"].data[...] = 1
    assert net._forward(0, len(net.layers) - 1) == pytest.approx(float(net.blobs["(automatic)"].data))
    net.backward()
    assert net.params["scores"][0].diff.any()
