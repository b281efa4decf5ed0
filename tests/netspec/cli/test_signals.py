"""Trainings react to signals and show their progress on a terminal."""

import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest

import forked
from paths import ROOT

pytestmark = pytest.mark.slow

SOLVER = "sgd_step/solver.prototxt"


class Training:
    """``netspec train``, forked; with ``python``, another command line in a Python that starts as usual."""

    def __init__(self, words: Sequence[str], name: str = "netspec", python: Sequence[str] = ()) -> None:
        self.log = Path("training.log").absolute()
        if python:
            environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
            with self.log.open("w") as stream:
                self.process = subprocess.Popen([sys.executable, *python, *words], stderr=stream, env=environment)
        else:
            self.process = forked.start(forked.program, [name, "train", *words], out=self.log)

    def status(self, limit_s: float = 300) -> int | None:
        """Return the exit status, once it has ended."""
        if isinstance(self.process, BaseProcess):
            return forked.wait(self.process, limit_s)
        return self.process.wait(limit_s)

    def is_over(self) -> bool:
        if isinstance(self.process, BaseProcess):
            return not self.process.is_alive()
        return self.process.poll() is not None

    def send(self, number: int) -> None:
        assert self.process.pid
        os.kill(self.process.pid, number)

    def wait_for(self, text: str) -> None:
        """Wait for a line of its log."""
        end = time.monotonic() + 300
        while not self.log.exists() or text not in self.log.read_text():
            assert time.monotonic() < end, self.log.read_text()[-2000:]
            assert not self.is_over(), self.log.read_text()[-2000:]
            time.sleep(0.02)


@pytest.fixture
def endless(work_in: Callable[..., Path]) -> Iterator[Callable[..., Training]]:
    """``endless(*words)``: a training of its own that does not end by itself."""
    work_in("train/sgd_step")
    text = Path(SOLVER).read_text().replace("max_iter: 60", "max_iter: 1000000")
    Path(SOLVER).write_text(text.replace("snapshot_after_train: false", ""))
    started: list[Training] = []

    def start(*words: str, **program: Any) -> Training:
        started.append(Training([SOLVER, *words], **program))
        return started[-1]

    yield start
    for training in started:
        training.process.kill()
        training.status()


def snapshots() -> set[str]:
    return {path.name for path in Path("sgd_step").glob("ref_iter_*.solverstate")} - {"ref_iter_60.solverstate"}


def last_messages(count: int) -> list[str]:
    return [line.partition("] ")[2] for line in Path("training.log").read_text().splitlines()[-count:]]


def test_an_interrupt_stops_a_training_and_takes_a_snapshot(endless) -> None:
    training = endless()
    training.wait_for("Iteration 10 ")
    training.send(signal.SIGINT)
    assert training.status() == 130
    assert last_messages(2) == ["Optimization stopped early.", "Optimization Done."]
    (state,) = snapshots()
    assert state.removesuffix(".solverstate") in last_messages(3)[0]


def test_a_hangup_takes_a_snapshot_and_training_continues(endless) -> None:
    training = endless()
    training.wait_for("Iteration 10 ")
    training.send(signal.SIGHUP)
    training.wait_for("Snapshotting solver state")
    before = Path("training.log").read_text().count(", loss = ")
    training.wait_for(f"Iteration {10 * (before + 2)} ")
    assert not training.is_over()
    assert len(snapshots()) == 1


def test_effects_of_signals_can_be_changed(endless) -> None:
    training = endless("--sigint_effect=none", "-sighup_effect", "stop")
    training.wait_for("Iteration 10 ")
    training.send(signal.SIGINT)
    training.wait_for("Iteration 100 ")
    assert not snapshots()
    training.send(signal.SIGHUP)
    assert training.status() == 129
    assert len(snapshots()) == 1


STARTS: dict[str, tuple[dict[str, Any], int]] = {
    "netspec": ({"python": ("-m", "netspec", "train")}, 143),
    "tools/train.py": ({"python": (str(ROOT / "tools" / "train.py"),)}, 0),
    "torchrun": ({"python": ("-m", "torch.distributed.run", "--standalone", "-m", "netspec", "train")}, 0),
}


@pytest.mark.parametrize("name", STARTS)
def test_sigterm_stops_a_training_with_a_snapshot(name: str, endless) -> None:
    """For a scheduler, status 0 means that the work is done; under Caffe's names, its users expect 0."""
    program, status = STARTS[name]
    training = endless(*["--sigint_effect=none"] * (name == "netspec"), **program)
    training.wait_for("Iteration 10 ")
    if name == "torchrun":
        line = next(line for line in training.log.read_text().splitlines() if "Iteration 10 " in line)
        os.kill(int(line.split()[2]), signal.SIGTERM)  # glog has the process there
    else:
        training.send(signal.SIGTERM)
    assert training.status() == status
    text = training.log.read_text()
    assert "Traceback" not in text
    assert text.index("Optimization stopped early.") < text.index("Optimization Done.")
    assert len(snapshots()) == 1


def test_the_status_depends_on_the_name_of_the_program(endless) -> None:
    training = endless(name="caffe")
    training.wait_for("Iteration 10 ")
    training.send(signal.SIGINT)
    assert training.status() == 0


def test_a_training_works_with_closed_stderr(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    Path(SOLVER).write_text(Path(SOLVER).read_text().replace("snapshot_after_train: false", ""))
    words = ["sh", "-c", 'exec "$@" 2>&-', "sh", sys.executable, "-m", "netspec", "train", SOLVER]
    done = subprocess.run(words, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, b"")
    assert Path("sgd_step/ref_iter_60.solverstate.extra").is_file()


def test_on_a_terminal_a_line_shows_the_progress(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    pty, fcntl, termios = map(pytest.importorskip, ("pty", "fcntl", "termios"))  # Windows has none of them
    terminal, given = pty.openpty()
    fcntl.ioctl(given, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))  # without columns no line is shown
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "TQDM_MININTERVAL": "0"}
    command = [sys.executable, "-m", "netspec", "train", SOLVER, "-q"]
    with subprocess.Popen(command, stderr=given, env=environment) as training:
        os.close(given)
        shown = b""
        with suppress(OSError):  # how Linux says that nobody writes any more
            while part := os.read(terminal, 1000):
                shown += part
    os.close(terminal)
    assert training.returncode == 0, shown
    assert re.search(rb"\r10 of 60 \|", shown), shown
    assert b"Iteration" not in shown, "Caffe's log has no such line, and -q hides the log"


WAYS = {
    "netspec train": ("-m", "netspec", "train", "solver.prototxt", "--allow-python-layers"),
    "netspec run": ("-m", "netspec", "run", "train.py"),
    "python": ("train.py",),
}


@pytest.mark.parametrize(
    ("way", "layer"),
    [
        ("netspec train", "Daemon"),
        ("netspec train", "Joined"),
        ("netspec train", "Pooled"),
        ("netspec run", "Joined"),
        ("python", "Joined"),
    ],
)
def test_a_training_with_a_process_of_a_python_layer_ends(way: str, layer: str, tmp_path: Path) -> None:
    """A forked process inherits the handlers of the training, but SIGTERM still ends it."""
    for name in ("prefetching.py", "train.py", "solver.prototxt"):
        text = (ROOT / "tests/netspec/cli/workers" / name).read_text()
        (tmp_path / name).write_text(text.replace("LAYER", layer))
    process = subprocess.Popen(
        [sys.executable, *WAYS[way]],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        out, said = process.communicate(timeout=300)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # workers that are left
    assert process.returncode == 0, said
    assert "Traceback" not in said
    assert "interrupted" not in said
    assert ("joined" in out) == (layer == "Joined")
