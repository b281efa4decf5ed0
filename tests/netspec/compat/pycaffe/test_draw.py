"""``caffe.draw``, which draws as ``netspec draw`` does."""

from pathlib import Path

import pytest
from google.protobuf import text_format

import netspec.compat.pycaffe.draw as draw
from netspec.compat.pycaffe.proto import caffe_pb2
from netspec.errors import SpecError

pytestmark = pytest.mark.slow


@pytest.fixture
def net():
    text = (Path(__file__).parent / "nets" / "draw.prototxt").read_text()
    return text_format.Parse(text, caffe_pb2.NetParameter())


def test_a_net_is_drawn_into_a_file(net, tmp_path: Path) -> None:
    draw.draw_net_to_file(net, str(tmp_path / "net.png"), "LR")
    assert (tmp_path / "net.png").read_bytes()[:4] == b"\x89PNG"
    assert b"conv/1" in draw.draw_net(net, "LR", "svg")
    with pytest.raises(SpecError, match=r"^Graphviz cannot draw this net as \.xyz: "):
        draw.draw_net(net, "LR", "xyz")


@pytest.mark.parametrize(("phase", "other"), [("TRAIN", "input"), ("TEST", "mnist")])
def test_a_phase_omits_layers_of_the_other(net, phase: str, other: str) -> None:
    assert other in draw.draw_net(net, ext="dot").decode()
    assert other not in draw.draw_net(net, ext="dot", phase=caffe_pb2.Phase.Value(phase)).decode()
