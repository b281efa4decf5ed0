"""Each way in which ``netspec train`` ends is recognized in its log, from stderr and from --log_dir."""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from netspec.errors import SpecError, Where
from netspec.inspect.logs.training_log import LogReader, read_log
from netspec.solver.solver import Solver

NET = """
layer { name: "d" type: "DummyData" top: "x" top: "y"
  dummy_data_param { shape { dim: 2 dim: 4 } shape { dim: 2 dim: 1 }
    data_filler { type: "constant" value: 1 } data_filler { type: "constant" value: 100 } } }
layer { name: "ip" type: "InnerProduct" bottom: "x" top: "ip"
  inner_product_param { num_output: 1 weight_filler { type: "constant" value: 0.1 } } }
layer { name: "loss" type: "EuclideanLoss" bottom: "ip" bottom: "y" top: "loss" }
"""
SOLVER = """
net: "net.prototxt" base_lr: 0.01 lr_policy: "fixed" max_iter: 4 display: 1
snapshot_prefix: "s" snapshot_after_train: false solver_mode: CPU
"""
WITHOUT_NAME = OSError(28, "No space left on device")


@pytest.fixture
def endings(
    run: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[str, str, Any]]:
    """``endings(*words)``: what the reader says of a training's stderr and of its file in --log_dir, and the result."""
    monkeypatch.chdir(tmp_path)
    Path("net.prototxt").write_text(NET)
    Path("solver.prototxt").write_text(SOLVER)
    Path("folder").mkdir()

    def states(*words: str) -> tuple[str, str, Any]:
        Path("stderr.log").write_text(run("train", "--solver", "solver.prototxt", *words).err)
        result = run("train", "--solver", "solver.prototxt", *words, "--log_dir", "folder")
        (path,) = Path("folder").iterdir()
        return read_log("stderr.log").state, read_log(path).state, result

    return states


def test_a_training_that_is_done(endings: Callable[..., tuple[str, str, Any]]) -> None:
    stderr, file, result = endings()
    assert (stderr, file, result.status) == ("done", "done", 0)


def test_a_training_that_an_infinite_loss_stops(endings: Callable[..., tuple[str, str, Any]]) -> None:
    Path("solver.prototxt").write_text(SOLVER.replace("0.01", "1e30"))
    stderr, file, result = endings()
    assert (stderr, file) == ("failed", "failed")
    assert "the loss is inf" in result.fault


def test_a_training_from_damaged_weights_fails_before_its_first_iteration(
    endings: Callable[..., tuple[str, str, Any]], run: Callable[..., Any]
) -> None:
    Path("w.caffemodel").write_text("nothing")
    stderr, file, _ = endings("--weights", "w.caffemodel")
    assert (stderr, file) == ("failed", "failed")
    result = run("plot", "stderr.log", "--out", "x.svg")
    assert result.out == "stderr.log: state failed, iterations 0\nx.svg\n"


@pytest.mark.parametrize(
    ("fault", "state"),
    [
        (SpecError("is damaged", Where("train_lmdb")), "failed"),
        (SpecError("is damaged", Where("net.prototxt", 3, 1, "d", "Data")), "failed"),
        (OSError(28, "No space left on device", "s_iter_2.caffemodel"), "failed"),
        (WITHOUT_NAME, "failed"),
        (MemoryError(), "failed"),
        (ModuleNotFoundError("No module named 'netspec.fast'", name="netspec.fast"), "failed"),
        (KeyboardInterrupt(signal.SIGTERM), "stopped early"),
    ],
    ids=["file", "line", "disk_full", "no_name", "memory", "missing_part", "interrupted"],
)
def test_a_training_that_an_error_ends(
    fault: BaseException,
    state: str,
    endings: Callable[..., tuple[str, str, Any]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def end(_: Solver) -> None:
        raise fault

    monkeypatch.setattr(Solver, "apply_update", end)
    stderr, file, result = endings()
    assert (stderr, file) == (state, state), result.err


def test_an_error_of_the_program_ends_the_file_too(
    endings: Callable[..., tuple[str, str, Any]], run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On stderr, Python prints its traceback after the log."""

    def end(_: Solver) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(Solver, "apply_update", end)
    with pytest.raises(ZeroDivisionError):
        run("train", "--solver", "solver.prototxt", "--log_dir", "folder")
    (path,) = Path("folder").iterdir()
    assert read_log(path).state == "failed"


def test_a_training_that_a_signal_stops(
    endings: Callable[..., tuple[str, str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    update = Solver.apply_update

    def interrupt(solver: Solver) -> None:
        signal.raise_signal(signal.SIGINT)
        update(solver)

    monkeypatch.setattr(Solver, "apply_update", interrupt)
    stderr, file, result = endings()
    assert (stderr, file, result.status) == ("stopped early", "stopped early", 130)


def test_the_stack_trace_below_a_failed_check_of_caffe_changes_nothing() -> None:
    reader = LogReader("log")
    for line in (
        "F0101 00:00:01.000000 1 math.cpp:1] Check failed: x",
        "*** Check failure stack trace: ***",
        "I0101 00:00:02.000000 2 solver.cpp:239] Iteration 1, loss = 1",  # of another process
    ):
        reader.feed(line)
    assert reader.log.state == "failed"
