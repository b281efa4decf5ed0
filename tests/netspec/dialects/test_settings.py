"""Settings of nets that forks added and that have no effect get a warning."""

import pytest

from netspec.net.build import build_net
from netspec.proto.text import parse_net_text


def test_settings_of_types_engines_and_memory_get_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    text = """mem_param { optimize_train: true } default_forward_type: FLOAT16 engine: "MKLDNN"
        layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 } } }
        layer { name: "relu" type: "ReLU" bottom: "data" top: "relu" forward_math: FLOAT16 engine: "MKL2017" }"""
    net = build_net(*parse_net_text(text, "n.prototxt"))
    assert net.shapes["relu"] == (2,)
    for name in ("1:1: mem_param", "1:36: default_forward_type", 'layer "relu" (ReLU): forward_math'):
        assert f"{name} has no effect" in caplog.text
    assert caplog.text.count("has no effect") == 4
