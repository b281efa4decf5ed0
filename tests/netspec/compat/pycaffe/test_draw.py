"""Nets as graphs. Caffe: python/caffe/test/test_draw.py."""

import sys
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import text_format

import netspec.compat.pycaffe.draw as draw
from netspec.compat.pycaffe.proto import caffe_pb2
from netspec.errors import SpecError
from paths import ROOT, last_parts

pydot = pytest.importorskip("pydot")

NET = (Path(__file__).parent / "nets" / "draw.prototxt").read_text()


@pytest.fixture
def net():
    return text_format.Parse(NET, caffe_pb2.NetParameter())


def names(graph: Any) -> set[str]:
    return {node.get_name().strip('"') for node in graph.get_nodes()}


def test_layers_and_blobs_are_nodes_with_edges_between_them(net) -> None:
    graph = draw.get_pydot_graph(net, "TB")
    assert {"data", "label", "conv", "pool", "ip", "loss", "relu (ReLU)"} <= names(graph)
    assert "conv/1 (Convolution) kernel size: 5 stride: 1 pad: 1" in names(graph)
    assert "pool (Pooling AVE) kernel size: 3 stride: 2 pad: 0" in names(graph)
    labels = {(e.get_source().strip('"'), e.get_destination().strip('"')): e.get_label() for e in graph.get_edges()}
    assert labels["mnist (Data)", "data"] == "Batch 64"
    assert labels["ip (InnerProduct)", "ip"] == "10"
    assert labels["conv", "pool (Pooling AVE) kernel size: 3 stride: 2 pad: 0"] == '""'
    assert graph.get_rankdir() == "TB"


def test_labels_have_several_lines_in_horizontal_drawings(net) -> None:
    assert r"pool\n(Pooling AVE)\nkernel size: 3\nstride: 2\npad: 0" in names(draw.get_pydot_graph(net, "LR"))


def test_edge_labels_are_optional(net) -> None:
    assert {edge.get_label() for edge in draw.get_pydot_graph(net, "LR", label_edges=False).get_edges()} == {'""'}


def test_a_phase_omits_layers_of_the_other(net) -> None:
    train = names(draw.get_pydot_graph(net, "TB", phase=caffe_pb2.TRAIN))
    test = names(draw.get_pydot_graph(net, "TB", phase=caffe_pb2.TEST))
    assert ("mnist (Data)" in train, "mnist (Data)" in test) == (True, False)
    assert ("input (Input)" in train, "input (Input)" in test) == (False, True)
    assert ("loss (SoftmaxWithLoss)" in train, "loss (SoftmaxWithLoss)" in test) == (True, False)


def test_rules_of_both_kinds_are_refused(net) -> None:
    net.layer[0].exclude.add(phase=caffe_pb2.TEST)
    with pytest.raises(ValueError, match="layer mnist has both include and exclude specified"):
        draw.get_pydot_graph(net, "TB", phase=caffe_pb2.TRAIN)


def test_multipliers_of_the_learning_rate(net) -> None:
    assert "conv/1 (Convolution) kernel size: 5 stride: 1 pad: 1 lr mult: 2.0, 1.0" in names(
        draw.get_pydot_graph(net, "TB", display_lrm=True)
    )
    with pytest.raises(ValueError, match="ReLU layers do not have a learning rate multiplier"):
        draw.get_layer_lr_mult(net.layer[3])


@pytest.mark.slow
def test_graphviz_text_needs_no_graphviz(net, tmp_path: Path) -> None:
    draw.draw_net_to_file(net, str(tmp_path / "net.dot"), "BT")
    (read,) = pydot.graph_from_dot_file(str(tmp_path / "net.dot"))
    assert names(read) >= {"data", "ip"}
    assert len(read.get_edges()) == sum(len(layer.bottom) + len(layer.top) for layer in net.layer)


def test_graphviz_draws_the_picture(net, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    draw.draw_net_to_file(net, str(tmp_path / "net.png"))
    assert (tmp_path / "net.png").read_bytes()[:4] == b"\x89PNG"
    assert b"conv/1" in draw.draw_net(net, "LR", "svg", caffe_pb2.TRAIN)
    with pytest.raises(SpecError, match=r"^Graphviz cannot draw this net as \.xyz: "):
        draw.draw_net(net, "LR", "xyz")


def test_without_pydot_one_line_gives_advice(net, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pydot", None)
    with pytest.raises(ImportError, match=r"^caffe\.draw needs pydot: pip install pydot, or "):
        draw.get_pydot_graph(net, "LR")


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", sorted(path for path in ROOT.glob("prototxt/**/*.prototxt") if "solver" not in path.name), ids=last_parts
)
def test_every_net_of_the_project_is_drawn(path: Path) -> None:
    drawn = text_format.Parse(path.read_text(), caffe_pb2.NetParameter())
    graph = draw.get_pydot_graph(drawn, "LR")
    assert len(graph.get_edges()) == sum(len(layer.bottom) + len(layer.top) for layer in drawn.layer)
