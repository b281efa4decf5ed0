"""Logs of trainings, of several versions of Caffe and of netspec: what is read, smoothed and shown."""

from pathlib import Path

import numpy as np
import pytest

from netspec.errors import SpecError
from netspec.inspect.logs.training_log import (
    Curve,
    LogReader,
    TrainingLog,
    read_log,
    shown_range,
    summary,
    thinned,
)
from paths import GOLDEN

CAFFES = GOLDEN / "log" / "caffe_train.log"
OLD = "I0101 00:00:{:02d}.000000   77 solver.cpp:239] {}"


def read(*messages: str) -> TrainingLog:
    reader = LogReader("log")
    for second, message in enumerate(messages):
        reader.feed(OLD.format(second, message))
    return reader.log


def test_read_log_reads_a_log_of_caffe() -> None:
    run = read_log(CAFFES)
    assert run.loss.iterations == [0, 10, 20, 30, 40, 50, 60]
    assert run.loss.values[1] == 0.0442083
    assert (run.rate.iterations, run.rate.values[2:4]) == ([0, 10, 20, 30, 40, 50], [0.005, 0.005])
    assert run.tests == {0: {"loss": Curve([0, 25, 50], [0.147966, 0.0510559, 0.0502543])}}
    assert run.train["loss"].values == run.loss.values[:-1]
    assert run.losses == {"loss"}
    assert (run.state, run.iteration) == ("done", 60)
    assert summary(run)["least test loss"] == "0.0502543 at 50"


def test_messages_of_other_versions_of_caffe_are_read() -> None:
    run = read(
        "Iteration 100, Testing net (#1)",
        "    Test net output #0: accuracy = 0.5",
        "Test score #1: 0.25",
        "Test loss: 0.75",
        "Iteration 100, loss = 1.5",
        "Iteration 100, lr = 0.01",
        "Iteration 200 (12.5 iter/s, 8s/100 iter), 1.2/90ep, loss = 1.25",
    )
    assert run.tests == {1: {"accuracy": Curve([100], [0.5]), "score 1": Curve([100], [0.25]),
                             "test loss": Curve([100], [0.75])}}  # fmt: skip
    assert run.loss == Curve([100, 200], [1.5, 1.25])


def test_messages_of_2014_are_read() -> None:
    run = read(
        "Iteration 500, lr = 0.001",
        "Iteration 500, loss = 1.5",
        "Iteration 500, Testing net",
        "Test score #0: 0.5504",
        "Test score #1: 1.27805",
        "Snapshotting to lenet_iter_500",
        "Snapshotting solver state to lenet_iter_500.solverstate",
    )
    assert run.tests == {0: {"score 0": Curve([500], [0.5504]), "score 1": Curve([500], [1.27805])}}
    assert (run.loss, run.rate) == (Curve([500], [1.5]), Curve([500], [0.001]))


def test_logs_without_glog_prefixes_and_of_several_nodes_are_read() -> None:
    reader = LogReader("log")
    for line in ("Iteration 10, loss = 0.5", "    Train net output #0: loss: a = b = 0.25 (* 1 = 0.25 loss)",
                 "[n0.d0.r0] Iteration 20 (2.5 iter/s, 4s/10 iter), 0.1/90.1ep, loss = 0.75",
                 "[n0.d0.r0]     Test net output #0: top-1 = 0.5"):  # fmt: skip
        reader.feed(line)
    assert reader.log.loss == Curve([10, 20], [0.5, 0.75])
    assert reader.log.train == {"loss: a = b": Curve([10], [0.25])}
    assert reader.log.tests == {0: {"top-1": Curve([20], [0.5])}}


@pytest.mark.parametrize("text", ["nan", "-nan", "1.#QNAN", "-1.#IND"])
def test_a_loss_of_nan_is_read_in_every_spelling(text: str) -> None:
    assert np.isnan(read("Iteration 1, loss = " + text).loss.values).all()


def test_elements_of_one_output_have_separate_names() -> None:
    lines = [f"    Test net output #{k}: {name} = {k}" for k, name in enumerate(["p", "p", "q", "p = r"])]
    run = read("Iteration 5, Testing net (#0)", *lines, "Iteration 9, Testing net (#0)", *lines)
    assert {name: curve.values for name, curve in run.tests[0].items()} == {
        "p": [0, 0], "p[1]": [1, 1], "q": [2, 2], "p = r": [3, 3]}  # fmt: skip


def test_a_resumed_training_replaces_repeated_lines() -> None:
    test = ["    Test net output #0: loss = {} (* 1 = {} loss)".format(*2 * [value]) for value in "123"]
    run = read("Iteration 0, loss = 1", "Iteration 10, loss = 2", "Iteration 15, Testing net (#0)", test[0],
               "Iteration 20, loss = 3", "Initializing solver from parameters: ", "Iteration 10, Testing net (#0)",
               test[1], "Iteration 10, loss = 4")  # fmt: skip
    assert run.loss == Curve([0, 10], [1, 4])
    assert run.tests[0]["loss"] == Curve([10], [2])


@pytest.mark.parametrize(
    ("line", "state"),
    [
        ("I0101 00:00:00.000000 1 solver.cpp:332] Optimization Done.", "done"),
        ("I0101 00:00:00.000000 1 solver.cpp:311] Optimization stopped early.", "stopped early"),
        ("F0101 00:00:00.000000 1 math.cpp:1] Check failed: error == cudaSuccess (2 vs. 0)  out of memory", "failed"),
        ("*** Aborted at 1 (unix time) try SIGABRT", "failed"),
        ("a b.prototxt:3:1: Iteration 500: the loss is nan; lower base_lr, or continue with --nan warn", "failed"),
        ("I0101 00:00:00.000000 1 net.cpp:1] something", "running"),
    ],
    ids=["done", "stopped_early", "check_failed", "aborted", "nan_loss", "running"],
)
def test_the_state_of_a_training_is_recognized(line: str, state: str) -> None:
    reader = LogReader("log")
    reader.feed(line)
    assert reader.log.state == state


@pytest.mark.parametrize(
    ("data", "what"),
    [(b"\xff\x00 no log", "contains no iteration"), (None, "cannot be read")],
    ids=["other_file", "missing_file"],
)
def test_other_files_than_logs_are_refused(tmp_path: Path, data: bytes | None, what: str) -> None:
    path = tmp_path / "x.log"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(SpecError, match=what):
        read_log(path)


def test_thinning_keeps_extremes_and_ends() -> None:
    x = np.arange(10000.0)
    y = np.sin(x)
    y[1234], y[4321], y[50] = 9, -9, np.nan
    few, kept = thinned(x, y, 100)
    assert len(few) <= 102
    assert {0, 1234, 4321, 9999} <= set(few)
    np.testing.assert_array_equal(kept, y[few.astype(int)])


def test_shown_range_ignores_early_outliers_and_contains_all_other_curves() -> None:
    loss = np.concatenate([[80.0], np.linspace(2, 1, 99)])
    low, high = shown_range([loss]) or (0, 0)
    assert (low, high) == (1, pytest.approx(2.6, abs=0.1))
    assert shown_range([loss, np.array([5.0, 6.0])]) == (1, pytest.approx(9.0))
    assert shown_range([np.array([80.0, 1, 2])]) == (1, 80)
    assert shown_range([np.full(3, np.nan)]) is None
