"""Whole passes of deploy nets are prepared: scripts see in the blobs' memory what layer-by-layer passes leave there."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import netspec.pycaffe as caffe

FILLERS = 'weight_filler { type: "gaussian" std: 0.2 } bias_filler { type: "uniform" min: -1 max: 1 }'
RELU = 'layer { name: "relu" type: "ReLU" bottom: "data" top: "relu" }'
NET = (Path(__file__).parent / "nets" / "prepared.prototxt").read_text()


@pytest.fixture
def net(net_of: Callable[..., caffe.Net]) -> caffe.Net:
    made = net_of(NET)
    made.params["bn"][1].data[...] = 2
    made.params["bn"][2].data[...] = 1
    made.blobs["data"].data[...] = np.random.default_rng(0).normal(size=(2, 8, 40, 40))
    return made


def by_layer(net: caffe.Net) -> dict[str, np.ndarray]:
    """Return copies of all blobs after a pass with a hook, which runs layer by layer."""
    net.before_forward(lambda _: None)
    net.forward()
    net.runner.hooks["before_forward"].clear()
    return {name: blob.data.copy() for name, blob in net.blobs.items()}


def assert_same(net: caffe.Net, expected: dict[str, np.ndarray]) -> None:
    for name, blob in net.blobs.items():
        largest = max(1.0, float(np.abs(expected[name]).max()))  # a sum may cancel: 1e-5 of the largest value
        np.testing.assert_allclose(blob.data, expected[name], rtol=1e-4, atol=1e-5 * largest, err_msg=name)


def test_all_blobs_exist_after_a_prepared_pass(net: caffe.Net) -> None:
    expected = by_layer(net)
    for blob in net.blobs.values():
        blob.data[...] = 0 if blob is not net.blobs["data"] else blob.data
    net.forward()
    assert net.runner.net.prepared is not None
    assert net.runner.net.prepared.sequences
    assert_same(net, expected)


def test_views_of_blobs_and_weights_stay_alive(net: caffe.Net) -> None:
    net.forward()
    shown, weights = net.blobs["conv"].data, net.params["conv"][0].data
    for value in (0.1, -0.2, 0.3):
        weights[...] = value
        net.params["scale"][1].data[...] = value
        net.forward()
        seen = shown.copy()
        expected = by_layer(net)
        np.testing.assert_allclose(seen, expected["conv"], rtol=1e-4, atol=1e-5)
        assert_same(net, expected)


def test_weights_written_between_passes_are_used_after_folding(net: caffe.Net) -> None:
    for k in range(4):
        net.forward()
        net.forward()
        net.params["conv"][0].data[k] *= 2
        net.params["bn"][0].data[...] += 0.1
        net.forward()
        assert_same(net, by_layer(net))


def test_blobs_take_the_shapes_that_follow_from_the_input(net: caffe.Net) -> None:
    for n in (1, 3, 2):
        net.blobs["data"].reshape(n, 8, 40, 40)
        net.blobs["data"].data[...] = n
        out = net.forward()
        assert out["prob"].shape == net.blobs["prob"].data.shape == (n, 5)
        assert net.blobs["flat"].shape == (n, 16 * 38 * 38)
        assert_same(net, by_layer(net))
        assert np.shares_memory(net.blobs["flat"].data, net.blobs["conv"].data)
        assert not np.shares_memory(net.blobs["kept"].data, net.blobs["conv"].data)


def test_a_part_of_a_net_reads_written_blobs(net: caffe.Net) -> None:
    net.forward()
    net.blobs["ip"].data[...] = 0
    np.testing.assert_allclose(net.forward(start="prob")["prob"], 0.2, rtol=1e-6)


def test_constants_are_kept_from_pass_to_pass(net_of: Callable[..., caffe.Net]) -> None:
    data = 'dummy_data_param { shape { dim: 2 dim: 3 } data_filler { type: "constant" value: 2 } }'
    net = net_of(f'layer {{ name: "data" type: "DummyData" top: "data" {data} }}\n{RELU}')
    net.blobs["data"].data[...] = -1  # as in Caffe: the layer wrote once, and writes no more
    assert net.forward()["relu"].tolist() == [[0, 0, 0]] * 2
