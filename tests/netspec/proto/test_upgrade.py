"""Older formats are upgraded to the current one, and every part keeps its position in the file."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import text_format

from case_files import read_cases
from netspec.errors import SpecError
from netspec.proto.schema import NetParameter, SolverParameter, V1LayerParameter
from netspec.proto.source_map import Position, SourceMap
from netspec.proto.text import parse_net_text, parse_solver_text, read_solver, write_text
from netspec.proto.upgrade import current as upgrade
from netspec.proto.upgrade.v0 import merge_padding, upgrade_v0

NETS = read_cases("netspec/proto/cases/upgrades.txt")
V0_LAYERS = read_cases("netspec/proto/cases/v0_layers.txt")
V0_FAULTS = read_cases("netspec/proto/cases/v0_faults.txt")
V0, V1 = NETS["V0"]["old"], NETS["V1"]["old"]
PASSES: list[Callable[[NetParameter, SourceMap], tuple[NetParameter, SourceMap]]] = [
    upgrade_v0,
    upgrade.upgrade_data,
    upgrade.upgrade_v1,
    upgrade.upgrade_input,
    upgrade.upgrade_batch_norm,
]


def net_of(text: str) -> NetParameter:
    return text_format.Parse(text, NetParameter())


def leaves(node: Position) -> list[Position]:
    """Return the positions of all parts, whole messages included."""
    return [node, *(leaf for nodes in node.fields.values() for inner in nodes for leaf in leaves(inner))]


@pytest.mark.parametrize("case", NETS.values(), ids=NETS)
def test_net_is_upgraded(case: dict[str, str]) -> None:
    net, source = parse_net_text(case["old"], "f")
    assert write_text(net) == write_text(net_of(case["new"]))
    assert len(source.layers) == len(net.layer)
    assert upgrade.upgrade_net(net, source)[0] is net


@pytest.mark.parametrize("case", NETS.values(), ids=NETS)
def test_passes_do_not_change_their_arguments_and_are_idempotent(case: dict[str, str]) -> None:
    net, source = parse_net_text(case["old"], "f", upgrade=False)
    assert upgrade.upgrade_net(net, source)[0] is not net
    for step in PASSES:
        before = net.SerializeToString(deterministic=True), source
        after, after_source = step(net, source)
        assert (net.SerializeToString(deterministic=True), source) == before
        again, again_source = step(after, after_source)
        assert again is after
        assert again_source is after_source
        net, source = after, after_source
    assert net == net_of(case["new"])


@pytest.mark.parametrize("case", NETS.values(), ids=NETS)
def test_the_place_of_every_part_is_the_line_with_its_value(case: dict[str, str]) -> None:
    net, source = parse_net_text(case["old"], "f")
    lines = case["old"].splitlines()
    for layer, position in zip(net.layer, source.layers, strict=True):
        for name in ("name", "bottom", "top"):
            for node, value in zip(position.fields.get(name, ()), _values(layer, name), strict=False):
                assert f'"{value}"' in lines[node.where.line - 1]
        for node in leaves(position):
            assert 0 < node.where.line <= len(lines)


def _values(layer: Any, name: str) -> list[str]:
    return [layer.name] if name == "name" else list(getattr(layer, name))


# ---- V0 ----


@pytest.mark.parametrize("case", V0_LAYERS.values(), ids=V0_LAYERS)
def test_v0_layer(case: dict[str, str], caplog: pytest.LogCaptureFixture) -> None:
    net, _ = parse_net_text(f'layers {{ layer {{ name: "l" {case["old"]} }} top: "t" }}', "f")
    assert net == net_of(f'layer {{ name: "l" top: "t" {case["new"]} }}')
    assert "Unknown parameter" not in caplog.text


def test_v0_parameter_of_another_type_is_dropped_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    net, _ = parse_net_text('layers { layer { name: "l" type: "relu"\n num_output: 3 new_num: 2 } }', "f")
    assert net == net_of('layer { name: "l" type: "ReLU" }')
    assert "f:2:2: Unknown parameter num_output for layer type relu" in caplog.messages
    assert "f:2:16: Unknown parameter new_num for layer type relu" in caplog.messages


def test_v1_layer_among_v0_layers_is_kept() -> None:
    net, _ = parse_net_text('layers { name: "a" type: RELU } layers { layer { name: "b" type: "tanh" } }', "f")
    assert net == net_of('layer { name: "a" type: "ReLU" } layer { name: "b" type: "TanH" }')


def test_padding_is_merged_where_its_blob_is_used_last_made() -> None:
    """A padding layer's output may have the name of its input; each consumer sees the last maker of a name."""
    text = """
      input: "x"
      layers { layer { name: "p" type: "padding" pad: 1 } bottom: "x" top: "x" }
      layers { layer { name: "c1" type: "conv" } bottom: "x" top: "x" }
      layers { layer { name: "c2" type: "conv" } bottom: "x" top: "y" }
    """
    net, _ = merge_padding(*parse_net_text(text, "f", upgrade=False))
    assert [(layer.layer.name, layer.layer.HasField("pad")) for layer in net.layers] == [("c1", True), ("c2", False)]


@pytest.mark.parametrize("case", V0_FAULTS.values(), ids=V0_FAULTS)
def test_v0_fault(case: dict[str, str]) -> None:
    start = 'input: "data" layers { layer { name: "p" type: "padding" } bottom: "data" top: "p" }\n'
    with pytest.raises(SpecError) as caught:
        parse_net_text(start + case["text"], "f")
    assert str(caught.value) == case["fault"]


# ---- V1 ----


def test_every_v1_type_has_a_name() -> None:
    types = [value.name for value in V1LayerParameter.DESCRIPTOR.enum_types_by_name["LayerType"].values]
    net, _ = parse_net_text("".join(f"layers {{ type: {name} }}\n" for name in types), "f")
    names = [layer.type for layer in net.layer]
    special = {"NONE": "", "SOFTMAX_LOSS": "SoftmaxWithLoss"}
    plain = [special.get(name, name.replace("_", "")).lower() for name in types]
    assert [name.lower() for name in names] == [name.lower() for name in plain]
    assert len(set(names)) == len(types) == 40


def test_every_parameter_of_a_v1_layer_is_carried_over() -> None:
    fields = [f.name for f in V1LayerParameter.DESCRIPTOR.fields if f.name.endswith("_param")]
    assert len(fields) > 25
    for name in fields:
        net, source = parse_net_text(f"layers {{\n {name} {{}} }}", "f")
        assert net == net_of(f"layer {{ {name} {{}} }}")
        assert str(source.at(0, name)) == "f:2:2"


@pytest.mark.parametrize(
    "old", ["type: DATA data_param", "type: IMAGE_DATA image_data_param", "type: WINDOW_DATA window_data_param"]
)
def test_transform_of_v1_data_layers(old: str) -> None:
    fields = 'scale: 2 mean_file: "m" crop_size: 3 mirror: true'
    net, _ = parse_net_text(
        f"layers {{ {old} {{ {fields} batch_size: 4 }} transform_param {{ force_gray: true }} }}", "f"
    )
    assert (
        net.layer[0].transform_param
        == net_of(f"layer {{ transform_param {{ {fields} force_gray: true }} }}").layer[0].transform_param
    )
    assert f"{old.split()[-1]} {{ batch_size: 4 }}" in " ".join(write_text(net).split())


def test_mixture_of_layer_and_layers_is_refused() -> None:
    with pytest.raises(SpecError, match=r'^f:2:1: "layers" is the older format, but the net has "layer" of line 3 too'):
        parse_net_text('name: "n"\nlayers { type: RELU }\nlayer { type: "ReLU" }', "f")
    both = net_of("layers {} layer {}")
    with pytest.raises(SpecError, match=r'^w: "layers" is the older format, but the net has "layer" too'):
        upgrade.upgrade_net(both, SourceMap.unknown("w", 2))


# ---- Inputs ----


def test_input_layer_is_put_first() -> None:
    net, source = parse_net_text('layer { name: "a" }\ninput: "d"\ninput_dim: [1, 2, 3, 4]', "f")
    assert [layer.name for layer in net.layer] == ["input", "a"]
    assert [str(source.at(i)) for i in range(2)] == ["f:2:1", "f:1:1"]
    assert not source.net.fields.keys() & {"input", "input_dim"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            'input: "a"\ninput: "b"\ninput_dim: [1, 2, 3, 4, 5]',
            "f:2:1: found 5 input_dim for 2 inputs, expected four each",
        ),
        ('input: "a"\ninput: "b"\ninput_shape {}', "f:2:1: found 1 input_shape for 2 inputs, expected one each"),
    ],
)
def test_input_without_a_shape_among_others_is_refused(text: str, message: str) -> None:
    with pytest.raises(SpecError) as caught:
        parse_net_text(text, "f")
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('\ninput: "a"', "f:2:1: input without input_shape or input_dim is not used"),
        ('input: "a"\ninput_dim: [1, 2, 3, 4,\n5]', "f:3:1: input_dim beyond four each of 1 inputs is not used"),
        ('input: "a" input_shape {}\ninput_shape {}', "f:2:1: input_shape beyond the 1 inputs is not used"),
        ('input: "a" input_shape {}\ninput_dim: 1', "f:2:1: input_dim together with input_shape is not used"),
    ],
)
def test_unused_input_fields_are_named(text: str, message: str, caplog: pytest.LogCaptureFixture) -> None:
    net, _ = parse_net_text(text, "f")
    assert message in caplog.messages
    assert not len(net.input) + len(net.input_shape) + len(net.input_dim)


# ---- What is logged ----


def test_the_log_equals_caffes(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        parse_net_text(V1, "old.prototxt")
    said = [(record.levelname, getattr(record, "site", ""), record.message) for record in caplog.records]
    assert said == [
        (
            "INFO",
            "upgrade_proto.cpp:44",
            "Attempting to upgrade input file specified using deprecated transformation parameters: old.prototxt",
        ),
        (
            "INFO",
            "upgrade_proto.cpp:47",
            "Successfully upgraded file specified using deprecated data transformation parameters.",
        ),
        (
            "WARNING",
            "upgrade_proto.cpp:49",
            "Note that future Caffe releases will only support transform_param messages for transformation fields.",
        ),
        (
            "INFO",
            "upgrade_proto.cpp:53",
            "Attempting to upgrade input file specified using deprecated V1LayerParameter: old.prototxt",
        ),
        ("INFO", "upgrade_proto.cpp:61", "Successfully upgraded file specified using deprecated V1LayerParameter"),
    ]


def test_a_current_net_is_returned_unchanged(caplog: pytest.LogCaptureFixture) -> None:
    net, source = parse_net_text('layer { name: "a" }', "f", upgrade=False)
    assert upgrade.upgrade_net(net, source) == (net, source)
    assert not caplog.messages


# ---- Solvers ----


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("SGD", "SGD"),
        ("NESTEROV", "Nesterov"),
        ("ADAGRAD", "AdaGrad"),
        ("RMSPROP", "RMSProp"),
        ("4", "AdaDelta"),
        ("ADAM", "Adam"),
    ],
)
def test_solver_type(old: str, new: str) -> None:
    solver, node = parse_solver_text(f"base_lr: 1\n solver_type: {old}", "s.prototxt")
    assert solver.type == new
    assert not solver.HasField("solver_type")
    assert str(node.find("type")) == "s.prototxt:2:2"


def test_both_solver_types_are_refused() -> None:
    with pytest.raises(SpecError, match=r'^s:2:1: both "type" and the older "solver_type" are given; keep "type"$'):
        parse_solver_text('type: "SGD"\nsolver_type: ADAM', "s")


def test_nets_in_a_solver_are_upgraded_in_place() -> None:
    text = (
        "net_param {\n  layers { type: RELU }\n}\n"
        'test_net_param { layer { name: "a" } }\n'
        'test_net_param {\n  input: "d" input_dim: [1, 1, 1,\n 1] }\n'
    )
    solver, node = parse_solver_text(text, "s")
    assert solver.net_param == net_of('layer { type: "ReLU" }')
    assert [[layer.name for layer in net.layer] for net in solver.test_net_param] == [["a"], ["input"]]
    source = SourceMap.of(node.fields["net_param"][0])
    assert str(source.at(0, "type")) == "s:2:12"
    source = SourceMap.of(node.fields["test_net_param"][1])
    assert str(source.at(0, "input_param", "shape", 0, "dim", 3)) == "s:7:2"
    raw, _ = parse_solver_text(text, "s", upgrade=False)
    assert upgrade.upgrade_solver(raw, Position(node.where))[0].net_param == solver.net_param


def test_snapshot_prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("snapshots").mkdir()
    Path("nets.v2").mkdir()
    for text, prefix in {
        "": "nets.v2/quick_solver",
        'snapshot_prefix: "snapshots"': "snapshots/quick_solver",
        'snapshot_prefix: "snapshots/"': "snapshots/quick_solver",
        'snapshot_prefix: "snapshots/run"': "snapshots/run",
        'snapshot_prefix: ""': "",
    }.items():
        Path("nets.v2/quick_solver.prototxt").write_text(text, encoding="utf-8")
        assert read_solver("nets.v2/quick_solver.prototxt").snapshot_prefix == prefix
    solver = SolverParameter()
    assert upgrade.upgrade_snapshot_prefix(solver, "./a/solver").snapshot_prefix == "./a/solver"
    assert not solver.HasField("snapshot_prefix")
