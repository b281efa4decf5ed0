"""``train --tensorboard``: what TensorBoard reads is what the log says."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("tensorboard", reason="pip install netspec-caffe[tensorboard]")
pytestmark = pytest.mark.slow

Run = Callable[..., Any]  # the fixtures of conftest.py
Edit = Callable[..., str]
INIT = ("--weights", "sgd_step/init.caffemodel")


def scalars(folder: str) -> dict[str, list[tuple[int, float]]]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    read = EventAccumulator(folder)
    read.Reload()
    return {name: [(event.step, event.value) for event in read.Scalars(name)] for name in read.Tags()["scalars"]}


@pytest.fixture
def solver(edited: Edit) -> Callable[[int], str]:
    def write(iterations: int) -> str:
        changes = ("max_iter: 60", f"max_iter: {iterations}", "display: 10", "display: 1 snapshot: 3")
        return edited("sgd_step/solver.prototxt", *changes, "test_interval: 1000", "test_interval: 3")

    return write


def test_losses_rates_and_tests_are_written(run: Run, solver: Callable[[int], str]) -> None:
    result = run("train", solver(6), *INIT, "--tensorboard", "board")
    assert result.status == 0
    found = scalars("board")
    assert set(found) == {"train/loss", "train/learning_rate", "test/loss"}
    logged = [float(line.split("loss = ")[1]) for line in result.messages if "iter/s" in line]
    assert [step for step, _ in found["train/loss"]] == list(range(6))
    assert [value for _, value in found["train/loss"]] == pytest.approx(logged, rel=1e-5)
    assert found["train/learning_rate"][0] == (0, pytest.approx(0.05))
    assert [step for step, _ in found["test/loss"]] == [3, 6]


def test_a_resumed_training_replaces_repeated_iterations(run: Run, solver: Callable[[int], str]) -> None:
    assert run("train", solver(5), *INIT, "--tensorboard", "board").status == 0
    snapshot = ("--snapshot", "sgd_step/ref_iter_3.solverstate")
    assert run("train", solver(7), *snapshot, "--tensorboard", "board").status == 0
    assert [step for step, _ in scalars("board")["train/loss"]] == list(range(7))


def test_faults(run: Run, solver: Callable[[int], str], monkeypatch: pytest.MonkeyPatch) -> None:
    Path("file").write_text("")
    assert run("train", solver(1), "--tensorboard", "file").fault == "file: cannot be written: Not a directory"
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    result = run("train", solver(1), "--tensorboard", "board")
    assert result.fault == "--tensorboard needs an extra package: pip install 'netspec-caffe[tensorboard]'"
    assert result.err.count("\n") == 1, "it is reported before the net's log"
