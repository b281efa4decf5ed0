"""The declarations of dialects: their fields and messages, and what is refused."""

import re
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool

from netspec.dialects import known
from netspec.dialects.declarations import read_declarations
from netspec.dialects.registry import Dialect, declare
from netspec.errors import SpecError
from netspec.proto import schema
from netspec.proto.schema import BlobProto, LayerParameter, NetParameter
from netspec.proto.text import parse_net_text, write_text

PROTO = Path(schema.__file__).parent

SOURCE = (Path(__file__).parent / "nets" / "dialect.proto").read_text()
NET = (Path(__file__).parent / "nets" / "dialect.prototxt").read_text()


MADE_UP = Dialect("madeup", SOURCE, ("Warp", "Bend"))


def add(dialect: Dialect) -> None:
    declare(dialect)
    known.add(dialect)


@pytest.fixture
def fork() -> Dialect:
    add(MADE_UP)
    return MADE_UP


@pytest.mark.usefixtures("fork")
def test_fields_of_a_dialect_are_read_and_written() -> None:
    net, source = parse_net_text(NET, "f")
    layer = net.layer[0]
    warp = schema.value(layer, "warp_param")
    assert list(warp.scale) == [0.5, 2]
    assert warp.filler.type == "xavier"
    assert (warp.border, warp.corner[0].id, warp.note, warp.on) == (0, 16, "a b", True)
    assert warp.tiny == pytest.approx(-1.5e-3)
    assert list(schema.value(layer, "ages")) == [4, 5]
    assert schema.value(layer.pooling_param, "sort") == 2
    assert schema.has(layer, "warp_param")
    assert not schema.has(LayerParameter(), "warp_param")
    assert not schema.has(LayerParameter(), "ages")
    assert schema.value(LayerParameter(), "warp_param").border == -1
    assert str(source.at(0, "warp_param", "scale", 1)) == "f:9:5"
    assert write_text(net) == NET
    assert write_text(NetParameter.FromString(net.SerializeToString())) == NET


@pytest.mark.usefixtures("fork")
def test_faults_in_a_dialects_fields_have_places() -> None:
    with pytest.raises(SpecError, match=r'^f:1:22: WarpParameter has no field "scal"; did you mean "scale"\? docs/'):
        parse_net_text("layer { warp_param { scal: 3 } }", "f")
    with pytest.raises(SpecError, match=r'^f:1:22: Corner lacks the required field "x"$'):
        parse_net_text("layer { warp_param { corner {} } }", "f")


@pytest.mark.usefixtures("fork")
def test_upgrades_carry_a_dialects_fields() -> None:
    net, source = parse_net_text("layer { name: 'a' }\ninput: 'x' input_dim: [1, 1, 1, 1] layer {\n ages: 3 }", "f")
    assert list(schema.value(net.layer[2], "ages")) == [3]
    assert str(source.at(2, "ages")) == "f:3:2"


def test_classes_and_schema_are_caffes_with_and_without_a_dialect(monkeypatch: pytest.MonkeyPatch) -> None:
    before = LayerParameter, schema.message("LayerParameter")
    with monkeypatch.context() as patch:
        patch.setattr(known, "_added", {})
        add(MADE_UP)
        parse_net_text("layer { warp_param {} }", "f")
    assert (LayerParameter, schema.message("LayerParameter")) == before
    with pytest.raises(SpecError, match=r'^f:2:2: LayerParameter has no field "warp_param"'):
        parse_net_text("layer {\n warp_param {} }", "f")


def test_an_unknown_type_or_field_is_an_error_with_the_dialects_that_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    one = Dialect("one", "extend LayerParameter { optional int32 lens = 700; }", ("Lens",))
    two = Dialect("two", "extend LayerParameter { optional int32 lens = 800; }", ("Lens",))
    found = known._found()
    monkeypatch.setattr(known, "_found", lambda: {**found, "one": one, "two": two})
    known._additions.cache_clear()
    additions, both = known.known(), ("one", "two")
    assert additions.types["Lens"] == both
    assert additions.fields["caffe.LayerParameter", "lens"] == both
    advice = 'dialects "one" and "two" have "lens"; add --plugin one, in Python netspec.use_dialect("one"), or write a'
    assert additions.advise("lens", both).startswith(advice)
    assert additions.advise("ReLU", ()) == ""
    with pytest.raises(SpecError, match=re.escape(advice)):
        parse_net_text("layer { lens: 1 }", "f")
    known._additions.cache_clear()


REFUSED = {
    "a field that Caffe has": (
        "extend LayerParameter { optional int32 name = 990; }",
        'bad.proto: caffe.LayerParameter already has a field "name"',
    ),
    "an unknown type": ("extend LayerParameter { optional Thing x = 991; }", "do not fit Caffe's schema"),
    "an unknown message": (
        "extend LayersParameter { optional int32 x = 991; }",
        'bad.proto: Caffe has no message "caffe.LayersParameter" to extend',
    ),
    "no label": (
        "message A {\n int32 x = 1; }",
        "bad.proto:2:2: expected message, enum, extend, or a field",
    ),
    "no number": ("message A { optional int32 x = y; }", "bad.proto:1:13: "),
    "another language": ("class A: pass", 'found "class A: pass"'),
    "another statement": ("service A {}", 'found "service A {}"'),
    "another option": ("message A { optional int32 x = 1 [lazy = true]; }", "bad.proto:1:13: "),
    "an end too many": ("message A {} }", "bad.proto:1:14: "),
    "an extend in a message": ("message A { extend LayerParameter { } }", "bad.proto:1:13: "),
    "an end too early": ("message A {", "bad.proto:1:12: the declarations end too early"),
}


@pytest.mark.parametrize(("source", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_bad_declarations_are_refused(source: str, message: str) -> None:
    with pytest.raises(SpecError) as caught:
        add(Dialect("bad", source))
    assert message in str(caught.value)
    assert known.added() == ()


def test_a_field_of_two_added_dialects_is_that_of_the_one_that_the_text_names(fork: Dialect) -> None:
    add(Dialect("rival", "extend LayerParameter { optional int32 warp_param = 900; }"))
    with pytest.raises(SpecError, match='dialects "madeup" and "rival" have "warp_param"'):
        parse_net_text("layer { warp_param {} }", "f")


@pytest.mark.parametrize("number", [100, 1 << 20, 900], ids=["Caffes", "none_of_Caffes", "another_dialects"])
def test_a_number_that_is_used_is_replaced(number: int, fork: Dialect) -> None:
    add(Dialect(f"with_{number}", f"extend LayerParameter {{ optional int32 x_{number} = {number}; }}"))
    (layer,) = parse_net_text(f"layer {{ x_{number}: 3 warp_param {{}} transform_param {{}} }}", "f")[0].layer
    assert schema.value(LayerParameter.FromString(layer.SerializeToString()), f"x_{number}") == 3


def test_two_texts_of_two_dialects_with_the_same_field_do_not_see_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    rival = Dialect("rival", "extend LayerParameter { optional int32 warp_param = 900; }")
    texts = {MADE_UP: "layer { warp_param { border: ZERO } }", rival: "layer { warp_param: 3 }"}
    for dialect in (MADE_UP, rival, MADE_UP):
        monkeypatch.setattr(known, "_added", {})
        add(dialect)
        (layer,) = parse_net_text(texts[dialect], "f")[0].layer
        found = schema.value(layer, "warp_param")
        assert found == 3 if dialect is rival else found.HasField("border")
    (field,) = schema.given(layer)
    assert field.descriptor.file.package == "caffe.madeup"


def test_declarations_equal_those_compiled_by_protoc(tmp_path: Path) -> None:
    protoc = pytest.importorskip("grpc_tools.protoc")
    header = 'syntax = "proto2"; package caffe.fork; import "caffe.proto";'
    (tmp_path / "fork.proto").write_text(header + SOURCE, "utf-8")
    # protoc wants the ranges that netspec opens by itself when it loads the schema.
    ranges = FileDescriptorProto()
    schema.pool.FindFileByName("caffe.proto").CopyToProto(ranges)
    opened = tmp_path / "caffe.desc"
    opened.write_bytes(FileDescriptorSet(file=[ranges]).SerializeToString())
    out = tmp_path / "fork.desc"
    arguments = [
        f"-I{tmp_path}",
        f"--descriptor_set_in={opened}",
        f"--descriptor_set_out={out}",
        str(tmp_path / "fork.proto"),
    ]
    assert protoc.main(["protoc", *arguments]) == 0
    theirs = FileDescriptorSet()
    theirs.ParseFromString(out.read_bytes())
    ours = read_declarations(SOURCE, "fork.proto", "caffe.fork")
    resolved = []
    for file in (ours, theirs.file[0]):
        pool = DescriptorPool()
        pool.Add(ranges)
        pool.Add(file)
        message = DescriptorProto()
        pool.FindMessageTypeByName("caffe.fork.WarpParameter").CopyToProto(message)
        for field in [*message.field, *message.nested_type[0].field]:
            field.ClearField("json_name")
        extensions: list[Any] = [pool.FindExtensionByName(f"caffe.fork.{e.name}") for e in file.extension]
        resolved.append((message, [(e.containing_type.full_name, e.number, e.type) for e in extensions]))
    assert resolved[0] == resolved[1]


def test_layers_of_a_fork_that_reuses_a_number_of_caffe_are_read() -> None:
    """caffe-face's center_loss_param has the number of Caffe's swish_param."""
    binary = LayerParameter(name="c", type="CenterLoss", blobs=[BlobProto(data=[1])]).SerializeToString()
    layer = LayerParameter.FromString(binary + b"\x9a\x09\x02\x08\x0a")  # 147 { 1: 10 }
    assert (layer.name, layer.type, list(layer.blobs[0].data)) == ("c", "CenterLoss", [1])
