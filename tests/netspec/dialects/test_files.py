"""Dialects are found by name, by path, by entry point and by what a prototxt uses; their errors take one line."""

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import netspec
import netspec.dialects
from fresh_dialects import used_by
from netspec import use_dialect
from netspec.cli import main
from netspec.dialects import known
from netspec.dialects.files import find_file, known_files, read_dialect
from netspec.errors import SpecError
from netspec.layers import layer_class, layer_types
from netspec.proto.text import parse_net_text
from paths import ROOT

NET = """
layer { name: "in" type: "Input" top: "x" input_param { shape { dim: 2 dim: 3 } } }
layer { name: "times" type: "Times" bottom: "x" top: "y" times_param { factor: 5 } }
"""


def example() -> str:
    """Return the file that the documentation shows."""
    shown = str(netspec.dialects.__doc__).split("pass ``--plugin doubling.py``::")[1]
    lines = shown.split("``DECLARATIONS`` is a string")[0].splitlines()
    return "\n".join(line.removeprefix("    ") for line in lines)


@pytest.fixture(scope="session")
def fork(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the documented example, once per process: what it declares stays in the schema's pool after a test."""
    path = tmp_path_factory.mktemp("fork") / "doubling.py"
    path.write_text(example())
    path.with_name("net.prototxt").write_text(NET)
    return path


@pytest.fixture
def fresh_files() -> Iterator[None]:
    for cached in (known_files, known._found, known._additions):
        cached.cache_clear()
    yield
    for cached in (known_files, known._found, known._additions):
        cached.cache_clear()


# ---- A file of the user ----


def test_the_documented_example_works_in_commands(fork: Path, capsys: pytest.CaptureFixture[str]) -> None:
    net = str(fork.with_name("net.prototxt"))
    assert main(["check", net]) == 1
    assert 'LayerParameter has no field "times_param"' in capsys.readouterr().err
    assert main(["check", net, "--plugin", str(fork)]) == 0
    assert re.search(r"times +Times +x +y +2x3", capsys.readouterr().out)
    assert main(["-plugin", str(fork), "check", net]) == 2  # an option of the command
    assert main(["layers", "--plugin", str(fork)]) == 0
    assert re.search(r"^Times +Multiply by a number\.$", capsys.readouterr().out, re.MULTILINE)
    assert known.added() == ("doubling",)


def test_the_documented_example_computes(fork: Path) -> None:
    netspec.use_dialect(fork)
    netspec.use_dialect(str(fork))  # again: nothing happens
    net = netspec.load_net(fork.with_name("net.prototxt"))
    x = np.arange(6, dtype=np.float32).reshape(2, 3)
    np.testing.assert_array_equal(net(x=x)["y"].numpy(), 5 * x)


def test_upgrade_net_proto_text_keeps_fields_of_a_dialect(fork: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.prototxt"
    net = str(fork.with_name("net.prototxt"))
    assert main(["upgrade_net_proto_text", net, str(out), "--plugin", str(fork)]) == 0
    assert "times_param {\n    factor: 5" in out.read_text()


def test_several_plugins_are_added_at_once(fork: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["layers", "--plugin", str(fork), "--plugin", "ssd", "--plugin", "blocks"]) == 0
    found = {line.split()[0] for line in capsys.readouterr().out.splitlines()}
    assert {"Times", "PriorBox", "MultiBoxLoss", "Axpy", "Convolution"} <= found
    assert known.added() == ("doubling", "ssd", "blocks")


FAULTS = {
    "no such dialect": (None, "ssdd", 'unknown dialect "ssdd"; did you mean "ssd"?'),
    "no similar dialect": (None, "x" * 20, f'unknown dialect "{"x" * 20}"; expected one of: blocks, c3d, densenet,'),
    "no such file": (None, "{path}", "{path}: cannot be read: No such file or directory"),
    "not text": (b"\xff\xfe", "{path}", "{path}: cannot be read: 'utf-8' codec can't decode"),
    "not Python": (b"a = 1\nclass B(:\n", "{path}", "{path}:2:9: this is not valid Python: "),
    "nothing in it": (b"a = 1\n", "{path}", "{path}: declares no dialect: neither DECLARATIONS nor a layer"),
    "computed": (
        b"import os\nDECLARATIONS = os.linesep\n",
        "{path}",
        "{path}:2:1: DECLARATIONS must be one plain string",
    ),
    "declarations that are none": (
        b'"""Mine."""\n\nDECLARATIONS = """\nmessage A {\n  int32 x = 1;\n}\n"""\n',
        "{path}",
        "{path}:5:3: expected message, enum, extend, or a field",
    ),
    "a field that Caffe has": (
        b'DECLARATIONS = "extend LayerParameter { optional int32 name = 990; }"\n',
        "{path}",
        '{path}: caffe.LayerParameter already has a field "name"',
    ),
    "a type that Caffe has": (
        b'from netspec.layers import *\n@register("ReLU")\nclass A(Layer): pass\n',
        "{path}",
        '{path}: layer type "ReLU" already exists, from netspec.layers.activation',
    ),
    "a fault when it runs": (
        b'from netspec.layers import register\n\nregister("Mine")(1 / 0)\n',
        "{path}",
        "{path}:3:1: cannot be loaded: ZeroDivisionError: division by zero",
    ),
}


@pytest.mark.parametrize(("content", "name", "message"), FAULTS.values(), ids=FAULTS.keys())
def test_errors_of_a_plugin_are_reported_in_one_line(
    content: bytes | None, name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"faulty_{abs(hash(message))}.py"
    if content is not None:
        path.write_bytes(content)
    assert main(["layers", "--plugin", name.format(path=path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(message.format(path=path))
    assert known.added() == ()


TRIPLING = """
from netspec.layers import Layer, register

@register("Times")
class Times(Layer):
    def reshape(self, bottom_shapes):
        return bottom_shapes

    def forward(self, data):
        return 3 * data
"""


def test_a_layer_of_two_added_dialects_is_that_of_the_one_that_the_file_names(fork: Path, tmp_path: Path) -> None:
    use_dialect(fork)
    (tmp_path / "tripling.py").write_text(TRIPLING)
    use_dialect(tmp_path / "tripling.py")
    net = tmp_path / "net.prototxt"
    net.write_text(NET.replace("times_param { factor: 5 }", ""))
    with pytest.raises(SpecError, match='shows "doubling" and "tripling"') as caught:
        netspec.load_net(net)
    assert 'a line "# dialect: doubling"' in caught.value.message
    net.write_text("# dialect: tripling\n" + net.read_text())
    assert netspec.load_net(net)(x=np.ones((2, 3)))["y"].tolist() == [[3] * 3] * 2


def test_two_files_of_one_name_are_refused(fork: Path, tmp_path: Path) -> None:
    use_dialect(fork)
    namesake = tmp_path / "elsewhere" / "doubling.py"
    namesake.parent.mkdir()
    namesake.write_text('DECLARATIONS = "extend LayerParameter { optional int32 more = 1001; }"\n')
    with pytest.raises(SpecError, match=rf'^{namesake}: another dialect "doubling" was added, from {fork}$'):
        use_dialect(namesake)


def test_any_file_name_can_be_used(tmp_path: Path) -> None:
    path = tmp_path / "my-fork 2.py"
    path.write_text('DECLARATIONS = "extend LayerParameter { optional int32 my_fork = 1002; }"\n')
    use_dialect(path)
    assert known.added() == ("my_fork_2",)
    parse_net_text("layer { my_fork: 3 }", "f")


# ---- Used because of fields and types, and layer types ----

FOUND = """
import logging, sys
from netspec.proto.text import parse_net_text
logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
for text in sys.argv[1:]:
    parse_net_text(text, "f")
print("torch" in sys.modules)
"""


def test_a_field_shows_its_dialect_without_importing_torch() -> None:
    texts = [
        "layer { prior_box_param { min_size: 1 } }",
        "layer { dropout_param { scale_train: true } }",
        "layer { interp_param {} }",
    ]
    command = [sys.executable, "-c", FOUND, *texts]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert said.splitlines() == [*(f"f: uses the dialect {name}" for name in ("ssd", "filters", "blocks")), "False"]


def test_a_layer_type_shows_its_dialect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    net = tmp_path / "net.prototxt"
    for kind in ("MultiBoxLoss", "Axpy", "PSROIPooling"):
        net.write_text(f'layer {{ name: "l" type: "{kind}" top: "x" }}')
        assert main(["check", str(net)]) == 1
        assert f'layer "l" ({kind}): ' in (said := capsys.readouterr().err)
        assert "unknown layer type" not in said
    net.write_text('layer { name: "l" type: "Convolutoin" top: "x" }')
    assert main(["check", str(net)]) == 1
    assert 'unknown layer type "Convolutoin"; did you mean "Convolution"?' in capsys.readouterr().err


def test_a_layer_type_of_two_dialects_is_refused_with_the_options_to_give(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    net = tmp_path / "net.prototxt"
    net.write_text('layer { name: "l" type: "ImageLabelmapData" top: "x" top: "y" }')
    assert main(["check", str(net)]) == 1
    said = capsys.readouterr().err
    assert 'unknown layer type "ImageLabelmapData"; dialects "hed" and "rcf" have "ImageLabelmapData"; add --' in said
    assert 'or write a line "# dialect: hed" into the prototxt' in said
    for name in ("rcf", "hed"):
        net.write_text(f'# dialect: {name}\nlayer {{ name: "l" type: "ImageLabelmapData" top: "x" top: "y" }}')
        assert main(["check", str(net)]) == 1
        assert 'layer "l" (ImageLabelmapData): source is missing' in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(known_files()))
def test_layer_types_read_from_the_source_equal_those_registered(name: str) -> None:
    before = set(layer_types())
    declared = read_dialect(find_file(name))
    use_dialect(name)
    assert set(layer_types()) - before == set(declared.layer_types)
    assert declared.fields() or declared.layer_types


# ---- Used by a whole prototxt ----


def test_a_prototxt_uses_the_dialects_it_needs(fresh_files: None) -> None:
    text = 'layer { name: "n" type: "Normalize" bottom: "x" top: "n" norm_param { across_spatial: false } }'
    assert used_by(text) == ["ssd"]
    assert layer_class("Normalize") is not None


def test_a_prototxt_of_caffes_layers_uses_no_dialect(fresh_files: None) -> None:
    text = 'layer { name: "Normalize" type: "ReLU" bottom: "Permute" top: "Swish" }'  # names, not types
    assert used_by(text) == []


def test_a_field_that_caffe_has_in_another_message_shows_its_dialect(fresh_files: None) -> None:
    before = layer_class("BatchNorm")
    text = 'layer { type: "Convolution" convolution_param { num_output: 1 bias_filler { type: "constant" } } }'
    assert used_by(text) == []
    assert used_by('layer { type: "BatchNorm" batch_norm_param { bias_filler { } } }') == ["nvidia"]
    assert layer_class("BatchNorm") is before


@pytest.mark.slow
def test_a_prototxt_of_two_dialects_uses_both(fresh_files: None) -> None:
    text = 'layer { type: "Permute" permute_param { order: 0 } } layer { type: "Axpy" } layer { type: "Normalize" }'
    assert used_by(text) == ["ssd", "blocks"]


def test_unknown_fields_and_types_use_no_dialect(fresh_files: None) -> None:
    assert used_by('layer { type: "NoSuchType" no_such_param { } }') == []


def test_docs_forks_md_lists_every_dialect() -> None:
    table = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs" / "forks.md").read_text(), re.MULTILINE)
    own = {name for name, file in known_files().items() if file.module.startswith("netspec.dialects.")}
    assert own <= set(table)
