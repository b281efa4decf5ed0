"""What a training does when a signal comes."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from paths import ROOT

pytestmark = pytest.mark.slow

SOLVER = "sgd_step/solver.prototxt"


@pytest.fixture
def endless(work_in: Callable[..., Path]) -> Iterator[Callable[..., tuple[subprocess.Popen, Callable[[str], None]]]]:
    """``endless(*words)``: a training of its own that does not end by itself, and how to wait for a line of its log."""
    work_in("train/sgd_step")
    text = Path(SOLVER).read_text().replace("max_iter: 60", "max_iter: 1000000")
    Path(SOLVER).write_text(text.replace("snapshot_after_train: false", ""))
    started: list[subprocess.Popen] = []

    def start(*words: str) -> tuple[subprocess.Popen, Callable[[str], None]]:
        log = Path("training.log")
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        with log.open("w") as stream:
            command = [sys.executable, "-m", "netspec", "train", SOLVER, *words]
            process = subprocess.Popen(command, stderr=stream, env=environment)
        started.append(process)

        def wait_for(text: str) -> None:
            end = time.monotonic() + 60
            while text not in log.read_text():
                assert time.monotonic() < end, log.read_text()[-2000:]
                assert process.poll() is None, log.read_text()[-2000:]
                time.sleep(0.05)

        return process, wait_for

    yield start
    for process in started:
        process.kill()
        process.wait()


def snapshots() -> set[str]:
    return {path.name for path in Path("sgd_step").glob("ref_iter_*.solverstate")} - {"ref_iter_60.solverstate"}


def last_messages(count: int) -> list[str]:
    return [line.partition("] ")[2] for line in Path("training.log").read_text().splitlines()[-count:]]


def test_an_interrupt_stops_a_training_and_takes_a_snapshot(endless) -> None:
    process, wait_for = endless()
    wait_for("Iteration 10 ")
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0
    assert last_messages(2) == ["Optimization stopped early.", "Optimization Done."]
    (state,) = snapshots()
    assert state.removesuffix(".solverstate") in last_messages(3)[0]


def test_a_hangup_takes_a_snapshot_and_training_goes_on(endless) -> None:
    process, wait_for = endless()
    wait_for("Iteration 10 ")
    process.send_signal(signal.SIGHUP)
    wait_for("Snapshotting solver state")
    before = Path("training.log").read_text().count(", loss = ")
    wait_for(f"Iteration {10 * (before + 2)} ")
    assert process.poll() is None
    assert len(snapshots()) == 1


def test_what_signals_do_can_be_changed(endless) -> None:
    process, wait_for = endless("--sigint_effect=none", "-sighup_effect", "stop")
    wait_for("Iteration 10 ")
    process.send_signal(signal.SIGINT)
    wait_for("Iteration 100 ")
    assert not snapshots()
    process.send_signal(signal.SIGHUP)
    assert process.wait(60) == 0
    assert len(snapshots()) == 1


def test_sigterm_stops_a_training_as_an_interrupt_does(endless) -> None:
    process, wait_for = endless()
    wait_for("Iteration 10 ")
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0
    assert last_messages(2) == ["Optimization stopped early.", "Optimization Done."]
    assert len(snapshots()) == 1


ENDLESS = """
import caffe, sys, time

class Endless(caffe.Layer):
    def setup(self, bottom, top):
        pass

    def reshape(self, bottom, top):
        top[0].reshape(1)

    def forward(self, bottom, top):
        print("begun", file=sys.stderr, flush=True)
        while True:
            time.sleep(0.1)
"""


def test_a_second_interrupt_ends_a_training_at_once(endless) -> None:
    """The first would wait for the end of an iteration, which takes for ever here."""
    Path("endless.py").write_text(ENDLESS)
    net = 'layer { name: "e" type: "Python" top: "e" python_param { module: "endless" layer: "Endless" } }'
    Path(SOLVER).write_text(f"net_param {{ {net} }} base_lr: 1 lr_policy: 'fixed' max_iter: 1 snapshot_prefix: 'x'")
    process, wait_for = endless("--allow-python-layers")
    wait_for("begun")
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    assert process.wait(10) == 130
