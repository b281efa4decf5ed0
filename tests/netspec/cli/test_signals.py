"""What a training does when a signal comes, and what it shows on a terminal."""

import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
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

    def start(
        *words: str, program: Sequence[str] = ("-m", "netspec", "train")
    ) -> tuple[subprocess.Popen, Callable[[str], None]]:
        log = Path("training.log")
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        with log.open("w") as stream:
            command = [sys.executable, *program, SOLVER, *words]
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
    assert process.wait(60) == 130
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
    assert process.wait(60) == 129
    assert len(snapshots()) == 1


NAMES = {
    "netspec": ((), 143),
    "no effect of Ctrl-C": (("--sigint_effect=none",), 143),
    "tools/train.py": ((), 0),
    "torchrun": ((), 0),
}


@pytest.mark.parametrize("name", NAMES)
def test_sigterm_stops_a_training_with_a_snapshot(name: str, endless, tmp_path: Path) -> None:
    """A scheduler takes 0 for the end of the work; under Caffe's names it is what Caffe's users expect."""
    words, status = NAMES[name]
    ready = {
        "tools/train.py": (str(ROOT / "tools" / "train.py"),),
        "torchrun": ("-m", "torch.distributed.run", "--standalone", "-m", "netspec", "train"),
    }
    process, wait_for = endless(*words, program=ready.get(name, ("-m", "netspec", "train")))
    wait_for("Iteration 10 ")
    number = process.pid
    if name == "torchrun":
        line = next(line for line in Path("training.log").read_text().splitlines() if "Iteration 10 " in line)
        number = int(line.split()[2])  # glog has the process there
    os.kill(number, signal.SIGTERM)
    assert process.wait(60) == status
    text = Path("training.log").read_text()
    assert "Traceback" not in text
    assert text.index("Optimization stopped early.") < text.index("Optimization Done.")
    assert len(snapshots()) == 1


@pytest.mark.parametrize("name", ["caffe", "netspec"])
def test_the_status_goes_by_the_name_of_the_program(name: str, endless) -> None:
    Path(name).write_text("import sys\nfrom netspec.terminal.main import program\nsys.exit(program('netspec.cli'))\n")
    process, wait_for = endless(program=(name, "train"))
    wait_for("Iteration 10 ")
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == (0 if name == "caffe" else 130)


def test_a_training_whose_standard_error_is_closed(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    Path(SOLVER).write_text(Path(SOLVER).read_text().replace("snapshot_after_train: false", ""))
    words = ["sh", "-c", 'exec "$@" 2>&-', "sh", sys.executable, "-m", "netspec", "train", SOLVER]
    done = subprocess.run(words, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, timeout=100)
    assert (done.returncode, done.stdout) == (0, b"")
    assert Path("sgd_step/ref_iter_60.solverstate.extra").is_file()


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


def test_on_a_terminal_a_line_says_how_far_it_is(work_in: Callable[..., Path]) -> None:
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
