"""Python layers in caffe.Net: what Caffe's test_python_layer.py and test_python_layer_with_param_str.py check."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import netspec.pycaffe as caffe
from paths import PYTHON_LAYERS


def layer(kind: str, name: str, bottom: str, more: str = "") -> str:
    bottoms = f'bottom: "{bottom}"' if bottom else ""
    return (
        f'layer {{ type: "Python" name: "{name}" {bottoms} top: "{name}" '
        f'python_param {{ module: "mine" layer: "{kind}" {more} }} }}\n'
    )


@pytest.fixture
def python_net(
    net_of: Callable[..., caffe.Net], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., caffe.Net]:
    """``python_net(text, phase)``: its module is found on sys.path, not in the working directory."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "mine.py").write_text(PYTHON_LAYERS.read_text())
    monkeypatch.syspath_prepend(tmp_path / "modules")
    monkeypatch.delitem(__import__("sys").modules, "mine", raising=False)
    return net_of


THREE = (
    'force_backward: true input: "data" input_shape { dim: 10 dim: 9 dim: 8 }\n'
    + layer("TimesTen", "one", "data")
    + layer("TimesTen", "two", "one")
    + layer("TimesTen", "three", "two")
)


def test_forward(python_net: Callable[..., caffe.Net]) -> None:
    net = python_net(THREE, caffe.TRAIN)
    net.blobs["data"].data[...] = 8
    net.forward()
    assert (net.blobs["three"].data == 8000).all()


def test_backward_needs_no_forward(python_net: Callable[..., caffe.Net]) -> None:
    net = python_net(THREE, caffe.TRAIN)
    net.blobs["three"].diff[...] = 7
    net.backward()
    assert (net.blobs["data"].diff == 7000).all()


def test_reshape(python_net: Callable[..., caffe.Net]) -> None:
    net = python_net(THREE, caffe.TRAIN)
    net.blobs["data"].reshape(4, 4, 4, 4)
    net.forward()
    assert {blob.data.shape for blob in net.blobs.values()} == {(4, 4, 4, 4)}
    net.blobs["data"].reshape(2, 3)
    net.reshape()
    assert {blob.data.shape for blob in net.blobs.values()} == {(2, 3)}


def test_exceptions_of_a_python_layer_are_passed_on(python_net: Callable[..., caffe.Net]) -> None:
    with pytest.raises(RuntimeError, match="setup of a broken layer"):
        python_net(layer("Broken", "broken", ""))
    net = python_net('input: "data" input_shape { dim: 1 }' + layer("Breaks", "breaks", "data"))
    with pytest.raises(ZeroDivisionError, match="forward of a broken layer"):
        net.forward()


def test_learnable_blobs(python_net: Callable[..., caffe.Net]) -> None:
    text = "force_backward: true\n" + layer("One", "layer", "")
    net = python_net(text, caffe.TRAIN)
    net.forward()
    net.backward()
    code = net.layers[list(net._layer_names).index("layer")]
    assert code.type == "Python"
    assert code.blobs[0].data[0] == 0
    assert code.blobs[0].diff[0] == 1
    code.blobs[0].data[0] += code.blobs[0].diff[0]
    assert code.blobs[0].data[0] == 1
    net.save("learned.caffemodel")
    code.blobs[0].data[0] = -1
    assert net.forward()["layer"] == [-1]
    net.copy_from("learned.caffemodel")
    assert code.blobs[0].data[0] == 1
    other = caffe.Net("net.prototxt", caffe.TRAIN)
    other.share_with(net)
    theirs = other.layers[list(other._layer_names).index("layer")]
    assert theirs.blobs[0].data[0] == 1
    code.blobs[0].data[0] = 5
    assert theirs.blobs[0].data[0] == 5
    assert other.forward()["layer"] == [5]


def test_phase(python_net: Callable[..., caffe.Net]) -> None:
    for phase in (caffe.TRAIN, caffe.TEST):
        net = python_net(layer("Phase", "phase", ""), phase)
        assert net.forward()["phase"] == phase
        assert str(net.layers[0].phase) == ("TRAIN", "TEST")[phase]  # as py-faster-rcnn asks for


def test_scripts_can_access_the_python_object_of_a_layer(python_net: Callable[..., Any]) -> None:
    text = 'layer { type: "Python" name: "rows" top: "row" top: "label" python_param { module: "mine" layer: "Rows" } }'
    net = python_net(text)
    assert net.blobs["label"].data == [7]  # written in setup
    net.layers[0].set_rows([[1, 2], [3, 4, 5]])
    assert net.forward()["row"].tolist() == [[1, 2]]
    assert net.forward()["row"].tolist() == [[3, 4, 5]]
    assert net.layers[0].kept[0] is net.blobs["row"]


def test_a_python_loss_among_other_layers(python_net: Callable[..., caffe.Net]) -> None:
    head = """
    input: "data" input_shape { dim: 6 dim: 5 } input: "wanted" input_shape { dim: 6 dim: 3 }
    layer { name: "fc" type: "InnerProduct" bottom: "data" top: "fc"
      inner_product_param { num_output: 3 } }
    """
    own = head + (
        'layer { name: "loss" type: "Python" bottom: "fc" bottom: "wanted" top: "loss" loss_weight: 1 '
        'python_param { module: "mine" layer: "Euclidean" } }'
    )
    caffes = head + 'layer { name: "loss" type: "EuclideanLoss" bottom: "fc" bottom: "wanted" top: "loss" }'
    nets = [python_net(text, caffe.TRAIN) for text in (own, caffes)]
    nets[1].share_with(nets[0])
    random = np.random.default_rng(0)
    nets[0].params["fc"][0].data[...] = random.normal(size=(3, 5))
    arrays: dict[str, Any] = {"data": random.random((6, 5)), "wanted": random.random((6, 3))}
    losses = [net.forward(**arrays)["loss"].reshape(()) for net in nets]
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)
    for net in nets:
        net.backward()
    mine, theirs = (net.params["fc"][0].diff for net in nets)
    np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-6)
    assert mine.any()
    assert not nets[0].blobs["wanted"].diff.any()
