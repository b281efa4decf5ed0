"""Text is read like protobuf reads it, and written like Caffe prints it."""

import re
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import text_format

from netspec.errors import SpecError
from netspec.proto.reader import read_text
from netspec.proto.schema import BlobProto, Datum, NetParameter, SolverParameter
from netspec.proto.text import parse_net, parse_net_text, parse_solver, read_net, read_solver, write_text
from paths import GOLDEN, SHARED, last_parts


def read(text: str, message: Any = None) -> Any:
    message = NetParameter() if message is None else message
    read_text(text, "test.prototxt", message)
    return message


def message_class(path: Path) -> type[Any]:
    return SolverParameter if "solver" in path.stem else NetParameter


# ---- Spellings ----

SPELLINGS = {
    "comments": '# one\nname: "n" # two\n#\nforce_backward: true#three',
    "angle brackets": 'name: "n" layer < name: "a" include < phase: TEST > >',
    "colon before a message": 'layer: { name: "a" convolution_param: { pad: 1 } }',
    "separators": 'name: "n", layer { name: "a"; type: "b", top: "c" }; input: "d"',
    "lists": 'layer { top: ["a", "b"] loss_weight: [1, 0.5] propagate_down: [true, f] } input_dim: [1,2,3,4] input: []',
    "list of messages": 'layer: [{ name: "a" }, < name: "b" >] input_shape [{ dim: [1, 2] }]',
    "adjacent strings": "name: 'a' \"b\"\n  'c'",
    "quotes in quotes": """name: 'say "x"' input: "it's" """,
    "escapes": r'name: "\a\b\f\n\r\t\v\\\'\"\101\x41\7"',
    "UTF-8": 'name: "né 回環"',
    "hex and octal": "input_dim: 0x1F input_dim: 010 input_dim: 0 input_dim: -0x10",
    "64 bits": "input_shape { dim: 9223372036854775807 dim: -9223372036854775808 }",
    "carriage returns": 'name: "n"\r\nlayer {\r\n  name: "a"\r\n}\r\n',
    "no spaces": 'name:"n"layer{name:"a"type:"b"}',
    "enum by name and number": "state { phase: TEST } layer { phase: 0 pooling_param { pool: 1 } }",
    "booleans": "layer { propagate_down: true propagate_down: t propagate_down: True propagate_down: 1 "
    "propagate_down: false propagate_down: f propagate_down: False propagate_down: 0 }",
    "floats": "layer { loss_weight: 1 loss_weight: -1.5e-3 loss_weight: .5 loss_weight: 2. loss_weight: 1E3 "
    "loss_weight: 3f loss_weight: inf loss_weight: -inf loss_weight: -Infinity loss_weight: 1e60 }",
    "empty": "",
    "empty message": "layer {} state <>",
}


@pytest.mark.parametrize("text", SPELLINGS.values(), ids=SPELLINGS.keys())
def test_spelling_reads_as_protobuf_reads_it(text: str) -> None:
    assert read(text) == text_format.Parse(text, NetParameter())


def test_not_a_number() -> None:
    (value,) = read("layer { loss_weight: NaN }").layer[0].loss_weight
    assert value != value


def test_a_list_of_devices_is_its_first(caplog: pytest.LogCaptureFixture) -> None:
    solver = read("base_lr: 1\ndevice_id: [2, 3] max_iter: 5", SolverParameter())
    assert (solver.device_id, solver.max_iter) == (2, 5)
    assert (
        "test.prototxt:2:1: device_id is a list: only the first is used; for several GPUs, use train --gpu 0,1"
        in caplog.text
    )


def test_texts_that_only_the_cpp_parser_accepts_are_read() -> None:
    """Python's own parser, or that of some versions, refuses these; Caffe's does not."""
    net = read("name: 'two\nlines\\? \\u00e9\\U0001F600' input_dim: 3input_dim: - 4 layer { loss_weight: 0.5F }")
    assert net.name == "two\nlines? é😀"
    assert list(net.input_dim) == [3, -4]
    assert list(net.layer[0].loss_weight) == [0.5]


def test_bytes_need_not_be_utf8() -> None:
    assert read(r'data: "\377\000a"', Datum()).data == b"\xff\x00a"


def test_ceil_mode_of_forks_is_round_mode() -> None:
    net, source = parse_net_text(
        "layer { pooling_param {\n ceil_mode: false } }\nlayer { pooling_param { ceil_mode: true } }", "f"
    )
    assert [layer.pooling_param.round_mode for layer in net.layer] == [1, 0]
    assert str(source.at(0, "pooling_param", "round_mode")) == "f:2:2"


def test_a_byte_order_mark_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "net.prototxt"
    path.write_bytes(b'\xef\xbb\xbfname: "n"\nforce_backward: 2')
    with pytest.raises(SpecError, match=r"net.prototxt:2:17: expected true or false"):
        read_net(path)
    path.write_bytes(b'\xef\xbb\xbfname: "n"')
    assert read_net(path).name == "n"


def test_comment_need_not_be_utf8(tmp_path: Path) -> None:
    path = tmp_path / "net.prototxt"
    path.write_bytes('name: "n"  # 网络\n'.encode("gbk"))
    assert read_net(path).name == "n"


# ---- Places ----


def test_everything_read_has_its_place() -> None:
    text = (
        'name: "n"\nlayer {\n  name: "a"\n  convolution_param { pad: [1,\n    2]\n  pad: 3 }\n}\n  layer { top: "x" }\n'
    )
    _, source = parse_net_text(text, "f")
    assert str(source.net.find("name")) == "f:1:1"
    assert str(source.at(0)) == "f:2:1"
    assert str(source.at(0, "convolution_param")) == "f:4:3"
    positions = [str(source.at(0, "convolution_param", "pad", i)) for i in range(3)]
    assert positions == ["f:4:29", "f:5:5", "f:6:3"]
    assert str(source.at(1, "top", layer="b", type="T")) == 'f:8:11: layer "b" (T)'
    assert str(source.at(1, "pooling_param", "pad")) == "f:8:3"


# ---- Writing ----


def logged(start: str, log: str) -> str:
    """Cut out what Caffe printed of a message into its log."""
    text = (GOLDEN / "log" / log).read_text(encoding="utf-8")
    match = re.search(rf"{re.escape(start)} *\n(.*?)^I\d+ ", text, re.DOTALL | re.MULTILINE)
    assert match is not None
    return match.group(1)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ("Initializing solver from parameters:", SolverParameter()),
        ("Initializing net from parameters:", NetParameter()),
    ],
)
def test_the_text_equals_caffes_log(start: str, message: Any) -> None:
    text = logged(start, "caffe_train.log")
    assert text.count("\n") > 15
    assert write_text(read(text, message)) == text


def test_writes_numbers_as_cpp_does() -> None:
    solver = SolverParameter(
        base_lr=0.1, gamma=1e-5, power=0.00390625, momentum=1 / 3, delta=1e-8, weight_decay=16777217
    )
    assert write_text(solver) == (
        "base_lr: 0.1\ngamma: 1e-05\npower: 0.00390625\nmomentum: 0.333333343\nweight_decay: 16777216\ndelta: 1e-08\n"
    )
    blob = BlobProto(double_data=[0.1, 1 / 3, float("inf"), float("-inf"), float("nan")], data=[3.4028234663852886e38])
    assert write_text(blob) == (
        "data: 3.40282347e+38\ndouble_data: 0.1\ndouble_data: 0.33333333333333331\n"
        "double_data: inf\ndouble_data: -inf\ndouble_data: nan\n"
    )


def test_writes_strings_as_cpp_does() -> None:
    assert write_text(NetParameter(name="a\"b'\\\n\té\x01")) == 'name: "a\\"b\\\'\\\\\\n\\t\\303\\251\\001"\n'


# ---- Against protobuf's own parser ----


def prototxts() -> list[Path]:
    folders = (GOLDEN / "ssd", GOLDEN / "forks")  # with fields of their own
    forks = {GOLDEN / "dnn" / "detect.prototxt", *(path for each in folders for path in each.rglob("*.prototxt"))}
    own = sorted(set(GOLDEN.rglob("*.prototxt")) - forks)
    corpus = (path for path in (SHARED / "corpus").rglob("*.prototxt") if path.stat().st_size < 20_000)
    return [*own, *sorted(corpus)]  # protobuf takes a second for each of the larger ones


@pytest.mark.slow
@pytest.mark.parametrize("path", prototxts(), ids=last_parts)
def test_files_read_as_protobuf_reads_them(path: Path) -> None:
    cls = message_class(path)
    expected = text_format.Parse(path.read_text(encoding="utf-8"), cls())
    if cls is SolverParameter:
        assert parse_solver(path, upgrade=False)[0] == expected
        assert read_solver(path).HasField("snapshot_prefix")
    else:
        net, source = parse_net(path, upgrade=False)
        assert net == expected
        assert len(source.layers) == len(net.layer) + len(net.layers)
        net, source = parse_net(path)
        assert len(source.layers) == len(net.layer) > 0
