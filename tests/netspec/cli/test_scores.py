"""``--scores``: what the tests of a training found, and its snapshots, for programs to read."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

NET = "sgd_step/train_val.prototxt"
SOLVER = "sgd_step/solver.prototxt"
INIT = "sgd_step/init.caffemodel"
TESTED = ("test_initialization: false", "")
Run = Callable[..., Any]  # the fixtures of conftest.py
Edit = Callable[..., str]


def scores() -> Any:
    return json.loads(Path("scores.json").read_text())


@pytest.fixture
def short(edited: Edit) -> Callable[[int], str]:
    """``short(iterations)``: a solver that tests every 2 iterations and takes a snapshot every 3."""

    def solver(iterations: int) -> str:
        changes = ("max_iter: 60", f"max_iter: {iterations} snapshot: 3", "snapshot_after_train: false", "")
        return edited(SOLVER, *changes, "test_interval: 1000", "test_interval: 2", *TESTED)

    return solver


def test_a_training_writes_each_test_and_each_snapshot(run: Run, short: Callable[[int], str]) -> None:
    result = run("train", short(5), "-weights", INIT, "-scores", "scores.json")
    assert result.status == 0
    found = scores()
    assert found["snapshots"] == [
        {"iteration": 3, "path": "sgd_step/ref_iter_3.caffemodel"},
        {"iteration": 5, "path": "sgd_step/ref_iter_5.caffemodel"},
    ]
    assert [(test["iteration"], test["net"]) for test in found["tests"]] == [(0, 0), (2, 0), (4, 0)]
    logged = [float(m[1]) for line in result.messages if (m := re.match(r" *Test net output #0: loss = (\S+)", line))]
    assert [list(test["outputs"]) for test in found["tests"]] == [["loss"]] * 3
    assert [test["outputs"]["loss"][0] for test in found["tests"]] == pytest.approx(logged, rel=1e-5)


def test_a_resumed_training_keeps_earlier_scores(run: Run, short: Callable[[int], str]) -> None:
    assert run("train", short(4), "--weights", INIT, "--scores", "scores.json").status == 0
    before = scores()
    assert [test["iteration"] for test in before["tests"]] == [0, 2, 4]
    again = "sgd_step/ref_iter_3.solverstate"
    assert run("train", short(6), "--snapshot", again, "--scores", "scores.json").status == 0
    after = scores()
    assert after["tests"][:2] == before["tests"][:2]
    assert [test["iteration"] for test in after["tests"]] == [0, 2, 4, 6]
    assert [snapshot["iteration"] for snapshot in after["snapshots"]] == [3, 6]


def test_a_new_training_starts_a_new_file(run: Run, short: Callable[[int], str]) -> None:
    Path("scores.json").write_text("anything")
    assert run("train", short(1), "--weights", INIT, "--scores", "scores.json").status == 0
    assert [test["iteration"] for test in scores()["tests"]] == [0]


def test_a_file_that_cannot_be_written_is_refused_before_training(run: Run, short: Callable[[int], str]) -> None:
    result = run("train", short(3), "--scores", "nowhere/scores.json")
    assert result.fault == "nowhere/scores.json: cannot be written: No such file or directory"
    assert not any(line.startswith("Solving") for line in result.messages)
    Path("scores.json").write_text("anything")
    assert run("train", short(3), "--snapshot", "sgd_step/ref_iter_60.solverstate", "--scores", "scores.json").fault
    assert Path("scores.json").read_text() == "anything"


def test_test_writes_scores_in_the_same_format(run: Run) -> None:
    result = run("test", "--model", NET, "--weights", INIT, "--iterations", "2", "--scores", "scores.json")
    assert result.status == 0
    (test,) = scores()["tests"]
    assert (test["iteration"], test["net"], scores()["snapshots"]) == (None, 0, [])
    assert test["outputs"]["loss"][0] == pytest.approx(float(result.messages[-1].split()[2]), rel=1e-5)
