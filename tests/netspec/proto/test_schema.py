"""The schema equals Caffe's to the last default, its compiled form is up to date, and it conflicts with no other."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool

from netspec.dialects.declarations import read_declarations
from netspec.proto import schema
from paths import ROOT

PROTO = ROOT / "netspec" / "proto"
TABLES = ROOT / "tests" / "golden" / "schema"


def compiled() -> FileDescriptorProto:
    files = FileDescriptorSet()
    files.ParseFromString((PROTO / "caffe.desc").read_bytes())
    (file,) = files.file
    return file


def table(name: str) -> list[dict[str, str]]:
    with open(TABLES / name, encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines, delimiter="\t", quoting=csv.QUOTE_NONE))


def spelled(field: FieldDescriptorProto) -> str:
    """Spell a field's type as the table does."""
    kind = FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()
    return f"{kind}:{field.type_name.removeprefix('.caffe.')}" if field.type_name else kind


def default(field: FieldDescriptorProto, text: str) -> str | float | None:
    """Read a default: one of a float by its value, since 1e-5 and 1e-05 are one number."""
    return float(text) if text and field.type == FieldDescriptorProto.TYPE_FLOAT else text


def test_every_field_is_caffes() -> None:
    file = compiled()
    fields = {(m.name, f.name): f for m in file.message_type for f in m.field}
    rows = {(row["message"], row["name"]): row for row in table("fields.tsv")}
    assert fields.keys() == rows.keys()
    for key, row in rows.items():
        field = fields[key]
        found = (
            field.number,
            FieldDescriptorProto.Label.Name(field.label).removeprefix("LABEL_").lower(),
            spelled(field),
            field.HasField("default_value"),
            default(field, field.default_value),
            "packed" if field.options.packed else "",
        )
        expected = (
            int(row["number"]),
            row["label"],
            row["type"],
            row["default"] != "",
            default(field, row["default"]),
            row["packed"],
        )
        assert found == expected, key


def test_every_enum_is_caffes() -> None:
    file = compiled()
    enums = {(e.name, v.name): v.number for e in file.enum_type for v in e.value}
    enums |= {(f"{m.name}.{e.name}", v.name): v.number for m in file.message_type for e in m.enum_type for v in e.value}
    rows = {(row["enum"], row["name"]): int(row["number"]) for row in table("enums.tsv")}
    assert enums == rows


def test_the_compiled_schema_equals_the_proto_file(tmp_path: Path) -> None:
    protoc = pytest.importorskip("grpc_tools.protoc")
    out = tmp_path / "caffe.desc"
    assert protoc.main(["protoc", f"-I{PROTO}", f"--descriptor_set_out={out}", "caffe.proto"]) == 0
    fresh = FileDescriptorSet()
    fresh.ParseFromString(out.read_bytes())
    assert list(fresh.file) == [compiled()]


def test_the_stub_for_type_checkers_equals_the_proto_file(tmp_path: Path) -> None:
    protoc = pytest.importorskip("grpc_tools.protoc")
    plugin = Path(sys.executable).with_name("protoc-gen-mypy")
    arguments = [f"-I{PROTO}", f"--plugin=protoc-gen-mypy={plugin}", f"--mypy_out={tmp_path}", "caffe.proto"]
    assert protoc.main(["protoc", *arguments]) == 0
    assert (tmp_path / "caffe_pb2.pyi").read_text() == (PROTO / "caffe_pb2.pyi").read_text()


def test_own_reader_of_declarations_agrees_with_protoc() -> None:
    source = (PROTO / "caffe.proto").read_text(encoding="utf-8")
    pools = DescriptorPool(), DescriptorPool()
    read = read_declarations(source.partition("package caffe;")[2], "caffe.proto", "caffe")
    del read.dependency[:]
    pools[0].Add(read)
    pools[1].Add(compiled())
    for message in compiled().message_type:
        ours, theirs = DescriptorProto(), DescriptorProto()
        pools[0].FindMessageTypeByName(f"caffe.{message.name}").CopyToProto(ours)
        pools[1].FindMessageTypeByName(f"caffe.{message.name}").CopyToProto(theirs)
        for field in theirs.field:
            field.ClearField("json_name")  # protoc writes it out
        assert ours == theirs


def test_defaults_reach_the_messages() -> None:
    solver = schema.SolverParameter()
    assert (solver.test_interval, solver.type, solver.solver_mode, solver.random_seed) == (0, "SGD", 1, -1)
    assert schema.message("BatchNormParameter")().eps == pytest.approx(1e-5)
    assert schema.message("HingeLossParameter")().norm == 1
    assert schema.LayerParameter().pooling_param.round_mode == 0


def test_unknown_message_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        schema.message("PoolParameter")


@pytest.mark.parametrize("first", ["theirs", "ours"])
def test_another_caffe_proto_in_the_process_does_no_harm(first: str) -> None:
    theirs = (
        "from google.protobuf import descriptor_pb2, descriptor_pool\n"
        "file = descriptor_pb2.FileDescriptorProto(name='caffe.proto', package='caffe')\n"
        "file.message_type.add(name='NetParameter').field.add(name='other', number=1, type=5, label=1)\n"
        "descriptor_pool.Default().Add(file)\n"
    )
    ours = "from netspec.proto.schema import NetParameter\nassert NetParameter(name='n').name == 'n'\n"
    code = theirs + ours if first == "theirs" else ours + theirs
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
