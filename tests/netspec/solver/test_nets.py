from pathlib import Path
from typing import Any

import pytest
from google.protobuf.message import Message

from case_files import read_cases
from netspec.errors import SpecError
from netspec.graph.filter import with_train_state
from netspec.proto.reader import read_text
from netspec.proto.source_map import Position
from netspec.proto.text import parse_solver_text
from netspec.solver.nets import SolverNet, solver_nets


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b", "c"):
        Path(f"{name}.prototxt").write_text(f'name: "{name}"')


def nets(text: str) -> list[SolverNet]:
    return solver_nets(*parse_solver_text(text, "s.prototxt"))


def named(found: list[SolverNet]) -> list[tuple[str, str, str]]:
    return [(part.label, part.net.name, part.origin) for part in found]


def test_one_net_for_training_and_tests():
    found = nets('net: "a.prototxt" test_iter: 1 test_interval: 1')
    assert named(found) == [("train net", "a", "net file: a.prototxt"), ("test net #0", "a", "net file: a.prototxt")]
    assert [part.net.state.phase for part in found] == [0, 1]


def test_without_test_iter_nothing_is_tested():
    assert named(nets('net: "a.prototxt"')) == [("train net", "a", "net file: a.prototxt")]


def test_test_nets_have_caffes_order():
    found = nets(
        'net_param { name: "general" } test_net: "b.prototxt" test_net: "c.prototxt" test_net_param { name: "within" }'
        "test_iter: 1 test_iter: 2 test_iter: 3 test_iter: 4 test_iter: 5 test_interval: 1"
    )
    assert named(found) == [
        ("train net", "general", "net_param"),
        ("test net #0", "within", "test_net_param"),
        ("test net #1", "b", "test_net file: b.prototxt"),
        ("test net #2", "c", "test_net file: c.prototxt"),
        ("test net #3", "general", "net_param"),
        ("test net #4", "general", "net_param"),
    ]


def test_a_net_without_test_net():
    found = nets('train_net: "a.prototxt" test_net: "b.prototxt" test_iter: 1 test_interval: 1')
    assert named(found) == [
        ("train net", "a", "train_net file: a.prototxt"),
        ("test net #0", "b", "test_net file: b.prototxt"),
    ]


def test_a_state_overrides_the_nets_own_which_overrides_the_solvers_default():
    net = 'net_param { state { level: 3 stage: "own" } }'
    found = nets(
        net + 'train_state { level: 5 stage: "t" } test_iter: 1 test_iter: 1 test_interval: 1'
        'test_state { stage: "x" } test_state { phase: TRAIN level: 7 }'
    )
    states = [(part.net.state.phase, part.net.state.level, list(part.net.state.stage)) for part in found]
    assert states == [(0, 5, ["own", "t"]), (1, 3, ["own", "x"]), (0, 7, ["own"])]


def test_the_command_lines_level_and_stages_reach_the_training_net_only():
    param, node = parse_solver_text('net: "a.prototxt" test_iter: 1 test_interval: 1', "s.prototxt")
    train, test = solver_nets(with_train_state(param, 0, ("",)), node)
    assert (train.net.state.level, list(train.net.state.stage)) == (0, [""])
    assert train.net.state.HasField("level")
    assert list(test.net.state.stage) == []
    assert not param.HasField("train_state")


def test_a_net_within_the_solver_keeps_its_locations():
    (train,) = nets('net_param {\n  layer { name: "x"\n    type: "ReLU" }\n}')
    assert str(train.source.at(0, "type")).startswith("s.prototxt:3:5")


REFUSED = read_cases("netspec/solver/cases/nets.txt")


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED)
def test_settings_that_caffe_refuses_are_refused(case: dict[str, str]):
    with pytest.raises(SpecError, match=case["message"]):
        nets(case["solver"])


def test_a_file_of_several_nets_is_read_once(monkeypatch: pytest.MonkeyPatch):
    read: list[str] = []

    def noted(text: str, file: str, message: Message, *report: Any) -> Position:
        read.append(file)
        return read_text(text, file, message, *report)

    monkeypatch.setattr("netspec.proto.text.read_text", noted)
    nets('net: "a.prototxt" test_net: "b.prototxt" test_net: "b.prototxt"' + "test_iter: 1 " * 4 + "test_interval: 1")
    assert read == ["s.prototxt", "a.prototxt", "b.prototxt"]


def test_all_errors_are_reported_if_collected():
    Path("broken.prototxt").write_text("layer {")
    text = """net: "gone.prototxt" train_net: "broken.prototxt"
test_net: "broken.prototxt" test_net: "missing.prototxt"
test_net: "b.prototxt"
test_iter: 1
test_state { } test_state { }"""
    faults: list[SpecError] = []
    found = solver_nets(*parse_solver_text(text, "s.prototxt"), faults.append)
    assert [str(fault).partition("; ")[0] for fault in faults] == [
        "s.prototxt:1:22: found net and train_net, expected exactly one of net, net_param, train_net, train_net_param",
        's.prototxt:1:1: net "gone.prototxt" is not a file',
        'broken.prototxt:1:8: the file ends inside "layer" of line 1',
        's.prototxt:2:29: test_net "missing.prototxt" is not a file',
        "s.prototxt:4:1: found 1 test_iter, expected 3, one for each test_net and test_net_param (or more)",
        "s.prototxt:5:1: found 2 test_state, expected none or one for each of the 3 test nets",
        "s.prototxt: found test_interval 0, expected more than 0, since the solver has a test net",
    ]
    assert [part.label for part in found] == ["test net #2"]
