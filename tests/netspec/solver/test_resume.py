"""A resumed training continues as if it had never stopped: same weights, same log, to the last bit."""

import json
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import lmdb
import numpy as np
import pytest

import netspec
from netspec.cli import main
from netspec.cli.resume import newest_pair
from netspec.data.database import Writer
from netspec.data.datum import array_to_datum
from netspec.errors import SpecError
from netspec.load import load_solver
from netspec.net.extra_file import extra_text
from netspec.solver.extra import extra_path, read_extra
from netspec.solver.snapshot import State, read_state, write_state
from netspec.solver.solver import Solver
from netspec.solver.update import RULES

pytestmark = pytest.mark.slow

SIDE = 10


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """37 images, as a database and as files in a list: no batch size divides their number."""
    monkeypatch.chdir(tmp_path)
    draw = np.random.default_rng(0)
    Path("images").mkdir()
    lines = []
    with Writer("db") as writer:
        for i in range(37):
            picture = draw.integers(0, 256, (SIDE, SIDE, 3)).astype(np.uint8)
            cv2.imwrite(f"images/{i}.png", picture)
            lines.append(f"images/{i}.png {i % 4}")
            writer.put(b"%08d" % i, array_to_datum(picture.transpose(2, 0, 1), i % 4).SerializeToString())
    Path("list.txt").write_text("\n".join(lines) + "\n")
    return tmp_path


DATA = (
    'layer { name: "data" type: "Data" top: "data" top: "label" data_param { source: "db" batch_size: 8 backend: LMDB }'
)
CROP = DATA + "transform_param { crop_size: 7 mirror: true scale: 0.01 } }"
LIST = """layer { name: "data" type: "ImageData" top: "data" top: "label" transform_param { scale: 0.01 }
  image_data_param { source: "list.txt" batch_size: 8 shuffle: true } }"""
DUMMY = """layer { name: "data" type: "DummyData" top: "data" top: "label" dummy_data_param {
  shape { dim: 8 dim: 12 } shape { dim: 8 } data_filler { type: "gaussian" } data_filler { type: "constant" } } }"""
CLASSIFY = """layer { name: "ip" type: "InnerProduct" bottom: "{bottom}" top: "ip"
  inner_product_param { num_output: 4 weight_filler { type: "xavier" } } }
layer { name: "loss" type: "SoftmaxWithLoss" bottom: "ip" bottom: "label" top: "loss" }"""
DROPOUT = 'layer { name: "drop" type: "Dropout" bottom: "data" top: "drop" }'
LSTM = (Path(__file__).parent / "nets" / "lstm.prototxt").read_text()
SOLVER = (Path(__file__).parent / "nets" / "solver.prototxt").read_text()
COUNTER = (Path(__file__).parent / "programs" / "counter.py").read_text()
HOOKS = """
    def running_state(self):
        return {"passes": self.passes}

    def resume(self, state):
        self.passes = state["passes"]
"""
POOL = """layer { name: "pool" type: "Pooling" bottom: "data" top: "pool"
  pooling_param { pool: STOCHASTIC kernel_size: 2 stride: 2 } }"""


INPUT = ('layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 3 dim: 10 dim: 10 } } }', "")


def state_of(weights: Path) -> str:
    return str(weights).replace("caffemodel", "solverstate")


def classify(bottom: str = "data") -> str:
    return CLASSIFY.replace("{bottom}", bottom)


NETS = {
    "batches of 8 of 37": DATA + "transform_param { scale: 0.01 } }" + classify(),
    "crop and mirror": CROP + classify(),
    "shuffled ImageData": LIST + classify(),
    "Dropout": CROP + DROPOUT + classify("drop"),
    "filler at run time": DUMMY + classify(),
    "LSTM": LSTM,
    "stochastic pooling": CROP + POOL + classify("pool"),
}


def write(net: str, more: str = "momentum: 0.9", solver: str = SOLVER) -> None:
    Path("net.prototxt").write_text(net)
    Path("solver.prototxt").write_text(solver + more)


def said(caplog: pytest.LogCaptureFixture, after: int) -> list[str]:
    """The losses, rates and scores from an iteration on, without times."""
    lines = [record.getMessage() for record in caplog.records]
    (start,) = [i for i, line in enumerate(lines) if line.startswith(f"Iteration {after} (") or line == "resumed"][-1:]
    return [
        line.partition(" (")[0] + line.partition("),")[2] for line in lines[start:] if "loss" in line or "lr" in line
    ]


def straight_and_resumed(caplog: pytest.LogCaptureFixture, at: int = 6) -> tuple[Solver, Solver, list[str], list[str]]:
    caplog.set_level(logging.INFO, "netspec")
    straight = load_solver("solver.prototxt")
    straight.param.snapshot = at
    straight.solve()
    log = said(caplog, at)
    caplog.clear()
    resumed = load_solver("solver.prototxt", snapshot=f"x_iter_{at}.solverstate")
    assert resumed.iteration == at
    resumed.solve()
    return straight, resumed, log, said(caplog, at)


def assert_same(straight: Solver, resumed: Solver) -> None:
    for mine, theirs in zip(straight.net.learnable, resumed.net.learnable, strict=True):
        assert mine.parameter.equal(theirs.parameter)
    for mine, theirs in zip(straight.history, resumed.history, strict=True):
        assert mine.equal(theirs)


@pytest.mark.parametrize("name", NETS)
def test_resuming_is_bit_identical(name: str, caplog: pytest.LogCaptureFixture) -> None:
    write(NETS[name])
    straight, resumed, log, log_after = straight_and_resumed(caplog)
    assert_same(straight, resumed)
    assert log_after == log
    assert len(log) > 20
    assert straight.scores == resumed.scores


@pytest.mark.parametrize("kind", RULES)
@pytest.mark.parametrize("form", ["BINARYPROTO", "HDF5"])
def test_every_solver_and_format_resumes(kind: str, form: str) -> None:
    momentum = "momentum: 0.9" if RULES[kind].momentum else ""
    write(NETS["Dropout"], f'type: "{kind}" {momentum} iter_size: 2 snapshot_format: {form}')
    straight = load_solver("solver.prototxt")
    straight.step(5)
    _, state = straight.snapshot()
    straight.step(5)
    resumed = load_solver("solver.prototxt", snapshot=state)
    resumed.step(5)
    assert_same(straight, resumed)


def test_a_snapshot_during_a_test_resumes_before_that_test() -> None:
    write(NETS["batches of 8 of 37"])
    asked: list[str | None] = []

    def action() -> str | None:
        asked.append("snapshot" if training.iteration == 4 and len(asked) == 6 else None)
        return asked[-1]

    training = load_solver("solver.prototxt", action=action)
    training.step(7)
    assert "snapshot" in asked
    resumed = load_solver("solver.prototxt", snapshot="x_iter_4.solverstate")
    resumed.step(3)
    assert resumed.scores == training.scores
    assert_same(training, resumed)


def test_without_the_extra_file_a_state_resumes_like_caffe(caplog: pytest.LogCaptureFixture) -> None:
    write(NETS["batches of 8 of 37"])
    solver = load_solver("solver.prototxt")
    solver.step(2)
    _, state = solver.snapshot()
    extra_path(state).unlink()
    caplog.set_level(logging.INFO, "netspec")
    resumed = load_solver("solver.prototxt", snapshot=state)
    assert "is from Caffe: the data starts at its first record" in caplog.text
    assert [layer.iteration for layer in resumed.net.layers if hasattr(layer, "iteration")] == [0]


def test_a_changed_random_seed_is_reported(warnings: Callable[[], list[str]]) -> None:
    write(NETS["crop and mirror"], "random_seed: 3")
    solver = load_solver("solver.prototxt")
    _, state = solver.snapshot()
    write(NETS["crop and mirror"], "random_seed: 4")
    load_solver("solver.prototxt", snapshot=state)
    assert warnings() == [f"{state}.extra: random_seed was 3; the random numbers differ from here on"]


OTHERWISE = [
    ({"batch_size: 8": "batch_size: 4"}, {}, 'layer "data" data_param.batch_size is 4, was 8'),
    ({'source: "db"': 'source: "copy"'}, {}, "layer \"data\" data_param.source is 'copy', was 'db'"),
    ({"mirror: true": ""}, {}, 'layer "data" transform_param.mirror is the default, was True'),
    ({"iter_size: 2": ""}, {}, "iter_size is the default, was 2"),
    ({"base_lr: 0.05": "base_lr: 0.01"}, {}, "base_lr is 0.01, was 0.05"),
    ({}, {"exact": "all"}, "exact is 'all', was 'small'"),
    ({}, {"precision": "bf16"}, "precision is 'bf16', was 'fp32'; exact is 'none', was 'small'"),
]


@pytest.mark.parametrize(("changed", "options", "reported"), OTHERWISE, ids=[reported for *_, reported in OTHERWISE])
def test_changes_that_affect_results_are_reported(
    changed: dict[str, str], options: Any, reported: str, warnings: Callable[[], list[str]]
) -> None:
    write(NETS["crop and mirror"], "iter_size: 2 random_seed: 3")
    shutil.copytree("db", "copy")
    _, state = load_solver("solver.prototxt").snapshot()
    for path in (Path("net.prototxt"), Path("solver.prototxt")):
        for old, new in changed.items():
            path.write_text(path.read_text().replace(old, new))
    load_solver("solver.prototxt", snapshot=state, **options)
    (said,) = [line for line in warnings() if line.startswith(state)]
    assert said.startswith(f"{state}.extra: the training continues, but its results will differ: ")
    assert reported in said


def test_a_changed_number_of_records_is_reported(warnings: Callable[[], list[str]]) -> None:
    write(NETS["crop and mirror"], "random_seed: 3")
    _, state = load_solver("solver.prototxt").snapshot()
    with lmdb.open("db", lock=False, map_size=1 << 24) as env, env.begin(write=True) as transaction:
        transaction.delete(b"%08d" % 36)
    load_solver("solver.prototxt", snapshot=state)
    assert 'train net, layer "data" number of records is 36, was 37' in warnings()[-1]


def test_changes_without_effect_are_not_reported(
    warnings: Callable[[], list[str]], caplog: pytest.LogCaptureFixture
) -> None:
    write(NETS["crop and mirror"], "random_seed: 3")
    _, state = load_solver("solver.prototxt").snapshot()
    Path("solver.prototxt").write_text(SOLVER.replace("max_iter: 13 display: 1", "max_iter: 99") + "random_seed: 3")
    Path("net.prototxt").write_text(NETS["crop and mirror"].replace('"xavier"', '"gaussian"'))
    caplog.set_level(logging.INFO, "netspec")
    load_solver("solver.prototxt", snapshot=state)
    assert warnings() == []
    assert "the training continues as if it had never stopped" in caplog.text


COUNTED = """layer { name: "c" type: "Python" bottom: "data" top: "c"
  python_param { module: "MODULE" layer: "Counter" } }"""


def counted(module: str, code: str) -> None:
    Path(f"{module}.py").write_text(code)
    write(CROP + COUNTED.replace("MODULE", module) + classify("c"), "random_seed: 3")


def test_a_python_layer_resumes_with_its_state(caplog: pytest.LogCaptureFixture) -> None:
    counted("counter_with_hooks", COUNTER + HOOKS)
    straight = load_solver("solver.prototxt", allow_python=True)
    straight.step(3)
    _, state = straight.snapshot()
    straight.step(3)
    resumed = load_solver("solver.prototxt", snapshot=state, allow_python=True)
    resumed.step(3)
    assert_same(straight, resumed)
    assert "are restored" not in caplog.text


def test_lost_state_of_a_python_layer_is_reported(warnings: Callable[[], list[str]]) -> None:
    counted("counter_without", COUNTER)
    _, state = load_solver("solver.prototxt", allow_python=True).snapshot()
    load_solver("solver.prototxt", snapshot=state, allow_python=True)
    (said,) = {line for line in warnings() if "are restored" in line}
    assert 'layer "c" (Python): only the blobs of the Python layer are restored' in said


def test_state_of_a_python_layer_must_fit_json() -> None:
    counted("counter_of_sets", COUNTER + HOOKS.replace("self.passes}", "{1, 2}}"))
    with pytest.raises(SpecError, match=r"Counter.running_state: returned what JSON cannot hold \(Object of type set"):
        load_solver("solver.prototxt", allow_python=True).snapshot()


# What is refused


@pytest.fixture
def state() -> Path:
    write(NETS["batches of 8 of 37"])
    solver = load_solver("solver.prototxt")
    solver.step(1)
    return Path(solver.snapshot()[1])


def refused(state: Path, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        load_solver("solver.prototxt", snapshot=state)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"iteration": -1}, "found iter -1, expected at least 0"),
        ({"current_step": -1}, "found current_step -1, expected at least 0"),
        ({"learned_net": ""}, "names no weights to resume with"),
        ({"learned_net": "gone.caffemodel"}, "its weights are neither gone.caffemodel nor "),
        ({"history": [np.full((4, 300), np.nan, np.float32), np.zeros(4, np.float32)]}, "history blob 0 has a NaN"),
    ],
)
def test_an_impossible_state_is_refused(state: Path, change: dict, message: str) -> None:
    whole = read_state(state)
    extra_path(state).unlink()
    write_state(state, State(**{**vars(whole), **change}))
    refused(state, message)


def test_weights_truncated_between_layers_are_refused(state: Path) -> None:
    """Protobuf reads them without a word; the file beside the state knows what was written."""
    weights = state.with_suffix(".caffemodel")
    data = weights.read_bytes()
    weights.write_bytes(data[: data.rindex(b"loss") - 4])
    refused(state, r"x_iter_1.caffemodel: is not the file that was written with x_iter_1.solverstate.extra")


@pytest.mark.parametrize("form", ["BINARYPROTO", "HDF5"])
def test_every_command_checks_the_hash_of_weights(form: str, capsys: pytest.CaptureFixture[str]) -> None:
    """One bit of a number: every reader would take it."""
    write(NETS["batches of 8 of 37"], f"snapshot_format: {form}")
    weights = Path(load_solver("solver.prototxt").snapshot()[0])
    Path("deploy.prototxt").write_text(classify().partition('layer { name: "loss"')[0].join(INPUT))
    commands = [
        ["test", "--model", "net.prototxt", "--weights", str(weights), "--iterations", "1"],
        ["extract", "--model", "net.prototxt", "--weights", str(weights), "--blob", "ip", "--out", "f.npz"],
        ["export", "deploy.prototxt", "--weights", str(weights), "--to", "torch", "--out", "e.py"],
    ]
    for command in commands:
        assert main(command) == 0, capsys.readouterr().err
    net = netspec.load_net("net.prototxt", weights=weights, phase="TRAIN")
    data = bytearray(weights.read_bytes())
    data[data.index(net.learnable[0].parameter.detach().numpy().tobytes()[:16]) + 2] ^= 1
    weights.write_bytes(data)
    capsys.readouterr()
    for command in commands:
        assert main(command) == 1
        (line,) = [line for line in capsys.readouterr().err.splitlines() if "truncated or replaced" in line]
        assert line.startswith(f"{weights}: is not the file that was written with x_iter_0.solverstate")
        assert line.endswith("; if you replaced it intentionally, remove " + extra_path(state_of(weights)).name)
    extra_path(state_of(weights)).write_text("{}")
    assert main(commands[0]) == 0
    assert f"{weights.name} was not checked against it" in capsys.readouterr().err


DAMAGED = r"x_iter_1.solverstate.extra: is damaged .*; if you remove it, the training resumes as in Caffe"


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"format": 2}', '{"format": 1, "seed": "x"}', "[" * 5000])
def test_a_damaged_extra_file_is_refused(state: Path, text: str) -> None:
    extra_path(state).write_text(text)
    refused(state, DAMAGED)


def forged(state: Path, *path: str | int, value: object) -> None:
    """Write another value beside a state, with a hash that is right."""
    content = json.loads(extra_path(state).read_text())
    inside = content
    for step in path[:-1]:
        inside = inside[step]
    inside[path[-1]] = value
    del content["hash"], content["format"]
    extra_path(state).write_text(extra_text(content))


@pytest.mark.parametrize(
    ("remembered", "message"),
    [
        ({"iteration": []}, r"found a saved state with iteration \(tuple\), expected iteration \(int\)"),
        ({"iteration": "x"}, r"found a saved state with iteration \(str\), expected iteration \(int\)"),
        ({"next": 3}, r"found a saved state with next \(int\), expected iteration \(int\)"),
    ],
)
def test_state_of_another_layer_type_is_refused(state: Path, remembered: dict, message: str) -> None:
    forged(state, "nets", 0, "0", value=remembered)
    refused(state, message)


# --resume


def test_resume_finds_the_newest_complete_snapshot(
    warnings: Callable[[], list[str]], caplog: pytest.LogCaptureFixture
) -> None:
    write(NETS["crop and mirror"], "snapshot: 5")
    assert main(["train", "solver.prototxt"]) == 0
    expected = Path("x_iter_10.caffemodel").read_bytes()
    Path("x_iter_11.solverstate").write_bytes(b"half a st")
    Path("x_iter_10.caffemodel").write_bytes(expected[:-9])
    assert newest_pair("x") == Path("x_iter_5.solverstate")
    assert [line.partition(": x")[0] for line in warnings()] == ["skipped"] * 2
    assert main(["train", "solver.prototxt", "--resume"]) == 0
    assert Path("x_iter_10.caffemodel").read_bytes() == expected
    for path in Path().glob("x_iter*"):
        path.unlink()
    assert main(["train", "solver.prototxt", "--resume"]) == 0
    assert read_extra("x_iter_10.solverstate") is not None
    for path in Path().glob("x_iter*.extra"):
        path.write_text(path.read_text().replace('"seed": ', '"seed": 1'))
    before = {path: path.read_bytes() for path in Path().glob("x_iter*")}
    assert main(["train", "solver.prototxt", "--resume"]) == 1  # it would start at iteration 0
    assert {path: path.read_bytes() for path in Path().glob("x_iter*")} == before
    assert main(["train", "solver.prototxt", "--resume", "--snapshot", "x_iter_5.solverstate"]) == 2
