"""Errors for names that a net does not have, and for inputs that are not arrays."""

from pathlib import Path

import numpy as np
import pytest
import torch

import netspec
from netspec.errors import SpecError
from netspec.net.net import Net

NET = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 3 } } }
layer { name: "ip" type: "InnerProduct" bottom: "data" top: "score" inner_product_param { num_output: 2 } }
layer { name: "prob" type: "Softmax" bottom: "score" top: "prob" }
"""


@pytest.fixture
def net(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Net:
    monkeypatch.chdir(tmp_path)
    Path("net.prototxt").write_text(NET)
    net = netspec.load_net("net.prototxt", seed=1)
    net(np.ones((1, 3)))
    return net


@pytest.mark.parametrize(
    ("find", "says"),
    [
        (lambda net: net.blobs["porb"], 'no blob "porb" in this net; did you mean "prob"? it has: '),
        (lambda net: net.shapes["x"], 'no blob "x" in this net; it has: data, score, prob'),
        (lambda net: net.blobs["score"], 'blob "score" was not kept; set net.keep = "all", or ["score"], and run the'),
        (lambda net: net.params["data"], 'no layer with learnable blobs "data" in this net; it has: ip'),
    ],
)
def test_an_unknown_name_is_a_key_error_with_known_names(net: Net, find, says: str) -> None:
    with pytest.raises(KeyError) as fault:
        find(net)
    assert says in fault.value.args[0]


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("x.png", "found a str for an input; expected an array of numbers or a tensor; read the file first"),
        (Path("x.png"), "expected an array of numbers or a tensor; read the file first, for example with cv2.imread"),
        (None, "found a NoneType for an input; expected an array of numbers or a tensor"),
        (["a", "b"], "found values of type <U1 for an input; expected an array of numbers or a tensor"),
    ],
    ids=["str", "Path", "None", "list_of_str"],
)
def test_an_input_that_is_not_an_array_is_refused(net: Net, value: object, says: str) -> None:
    with pytest.raises(SpecError) as fault:
        net(value)
    assert str(fault.value).startswith("net.prototxt: ")
    assert says in str(fault.value)


@pytest.mark.parametrize(
    "value",
    [np.array([[3.0, 2.0, 1.0]])[:, ::-1], np.array([[1, 2, 3]], ">f4"), [[1, 2, 3]]],
    ids=["reversed", "big-endian", "list"],
)
def test_arrays_of_every_layout_are_taken(net: Net, value: object) -> None:
    assert torch.equal(net(value)["prob"], net(np.array([[1.0, 2.0, 3.0]]))["prob"])
