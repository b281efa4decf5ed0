"""Training in several processes that torchrun starts: on the CPU, by gloo."""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch

import forked
from netspec.cli import main
from netspec.cli.resume import newest_pair
from netspec.load import load_solver
from netspec.solver.extra import read_extra
from netspec.solver.solver import Solver
from paths import GOLDEN

pytestmark = pytest.mark.slow
CPU = torch.device("cpu")
LIMIT = 120  # seconds
TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
SOLVER = """net: "net.prototxt" base_lr: 0.01 lr_policy: "step" gamma: 0.5 stepsize: 20 momentum: 0.9
max_iter: {iterations} snapshot_prefix: "{prefix}" snapshot: {snapshot} random_seed: 7 average_loss: 3
test_iter: 1 test_interval: 20
snapshot_after_train: {after} solver_mode: CPU"""
NET = """layer {{ name: "pairs" type: "Data" top: "pairs" top: "sim"
  transform_param {{ scale: 0.00390625 mirror: true }}
  data_param {{ source: "pairs/train_lmdb" batch_size: {batch} backend: LMDB rand_skip: 17 }} }}
layer {{ name: "conv" type: "Convolution" bottom: "pairs" top: "conv"
  convolution_param {{ num_output: 4 kernel_size: 5 stride: 2 weight_filler {{ type: "xavier" }} }} }}
{middle}
layer {{ name: "relu" type: "ReLU" bottom: "conv" top: "conv" }}
layer {{ name: "ip" type: "InnerProduct" bottom: "conv" top: "ip"
  inner_product_param {{ num_output: 2 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "loss" type: "SoftmaxWithLoss" bottom: "ip" bottom: "sim" top: "loss" }}"""
LAYERS_WITH_STATE = """layer { name: "bn" type: "BatchNorm" bottom: "conv" top: "conv" }
layer { name: "drop" type: "Dropout" bottom: "conv" top: "conv" }"""


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")
    monkeypatch.chdir(tmp_path)


def write(
    batch: int, iterations: int, prefix: str = "x", middle: str = "", snapshot: int = 0, after: str = "true"
) -> None:
    Path("net.prototxt").write_text(NET.format(batch=batch, middle=middle))
    text = SOLVER.format(iterations=iterations, prefix=prefix, snapshot=snapshot, after=after)
    Path("solver.prototxt").write_text(text)


def start(*options: str) -> "subprocess.Popen[str]":
    command = [*TORCHRUN, "-m", "netspec", "train", "--solver", "solver.prototxt", *options]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True)


def train(*options: str, status: int = 0) -> str:
    """Train in two processes and return what they wrote to stderr."""
    words = [*TORCHRUN[2:], "-m", "netspec", "train", "--solver", "solver.prototxt", *options]
    done = forked.run(forked.main, TORCHRUN[2], words, folder=Path.cwd())
    assert (done.returncode != 0) == (status != 0), done.stderr
    return done.stderr


def weights(solver: Solver, snapshot: str = "") -> list[np.ndarray]:
    if snapshot:
        solver.restore(snapshot)
    return [blob.detach().numpy().copy() for blobs in solver.net.params.values() for blob in blobs]


def process_of_rank(rank: int, parent: int) -> int:
    """Return the process id of a rank, by the environment that torchrun gives it."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            its_parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if its_parent == parent and f"RANK={rank}".encode() in (folder / "environ").read_bytes().split(b"\0"):
                return int(folder.name)
        except OSError:
            continue
    raise AssertionError(f"no process of rank {rank}")


def end_all(started: "subprocess.Popen[str]") -> None:
    """Kill what is left of a training; torchrun gives each of its processes a session of its own."""
    for rank in range(2):
        with suppress(AssertionError, ProcessLookupError):
            os.kill(process_of_rank(rank, started.pid), signal.SIGKILL)
    started.kill()
    started.wait()


def wait_for_training(started: "subprocess.Popen[str]") -> None:
    """Wait for the log of the first iterations."""
    assert started.stderr is not None
    for line in started.stderr:
        if "Starting Optimization" in line:
            return
    raise AssertionError("the training did not start")


def test_two_processes_follow_one_with_twice_the_batch() -> None:
    write(batch=8, iterations=21)
    reported = train()
    assert reported.count("Iteration 20, Testing net (#0)") == 1, "one log"
    assert sorted(p.name for p in Path().glob("x_*")) == [
        "x_iter_21.caffemodel",
        "x_iter_21.solverstate",
        "x_iter_21.solverstate.extra",
    ]
    write(batch=16, iterations=21)
    alone = load_solver("solver.prototxt")
    begun = weights(alone)
    alone.step(21)
    expected = weights(alone)
    found = weights(alone, "x_iter_21.solverstate")
    for mine, theirs, before in zip(found, expected, begun, strict=True):
        assert abs(mine - before).max() > 1e-3, "it learned"
        assert np.allclose(mine, theirs, rtol=0, atol=1e-5 * abs(theirs).max() + 1e-6)
    alone.close()


def test_processes_have_their_own_statistics_and_resume_bit_identically() -> None:
    """As the replicas of one process, to the bit: also where batches of half the size are not one of the whole."""
    write(batch=8, iterations=20, middle=LAYERS_WITH_STATE, snapshot=10)
    train()
    together = load_solver("solver.prototxt", device=[CPU, CPU])
    together.step(10)
    expected = weights(together)
    first, second = (net.params["bn"][0].detach() for net in (together.net, *together.replicas.nets))
    assert not torch.equal(first, second)
    found = weights(together, "x_iter_10.solverstate")
    for mine, theirs in zip(found, expected, strict=True):
        assert np.array_equal(mine, theirs)
    together.close()

    ends = []
    for words in ([], ["--resume"]):
        if words:
            assert "as if it had never stopped" in train(*words)
        extra = read_extra("x_iter_20.solverstate")
        assert extra is not None
        assert len(extra.nets) == 3, "two of training and one of testing"
        ends.append((Path("x_iter_20.caffemodel").read_bytes(), extra.nets, extra.losses))
        for path in Path().glob("x_iter_20.*"):
            path.unlink()
    assert ends[0] == ends[1]


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")
def test_a_killed_process_ends_the_training_with_a_complete_snapshot() -> None:
    write(batch=2, iterations=10**7, after="false")
    settings = Path("solver.prototxt")
    settings.write_text(settings.read_text().replace("test_interval: 20", "test_interval: 10000000"))
    started = start()
    try:
        wait_for_training(started)
        other = process_of_rank(1, started.pid)
        os.kill(other, signal.SIGHUP)  # any process may ask for a snapshot
        end = time.monotonic() + LIMIT
        while not list(Path().glob("x_iter_*.solverstate")):
            assert time.monotonic() < end, "no snapshot was taken"
            time.sleep(0.05)
        os.kill(other, signal.SIGKILL)
        _, reported = started.communicate(timeout=LIMIT)
    finally:
        end_all(started)
    assert started.returncode != 0
    lines = [line for line in reported.splitlines() if "rank 0 of 2" in line]
    (state,) = Path().glob("x_iter_*.solverstate")
    assert len(lines) == 1, reported
    assert re.fullmatch(r"rank 0 of 2: another process ended.*; the last snapshot is (.*); start .*--resume", lines[0])
    assert str(state) in lines[0]
    assert newest_pair("x") == state


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")
def test_a_process_that_must_end_does_not_wait_for_a_hanging_one() -> None:
    """Gloo can miss the death of a process: one that is stopped is as silent."""
    write(batch=2, iterations=10**7, after="false")
    started = start()
    try:
        wait_for_training(started)
        other = process_of_rank(1, started.pid)
        os.kill(other, signal.SIGSTOP)
        os.kill(process_of_rank(0, started.pid), signal.SIGTERM)
        assert started.stderr is not None
        reported = next(line for line in started.stderr if line.startswith("rank 0 of 2"))
        assert "another process ended, or has not answered for 15 seconds" in reported
        assert any(f"Sending process {other} closing signal" in line for line in started.stderr), "it ended by itself"
    finally:
        end_all(started)


def test_an_error_in_the_files_is_reported_once() -> None:
    write(batch=8, iterations=10)
    Path("net.prototxt").write_text(Path("net.prototxt").read_text().replace("Convolution", "Convolutoin", 1))
    reported = train(status=1)
    assert len([line for line in reported.splitlines() if line.startswith("net.prototxt:")]) == 1, reported


def test_gpu_is_refused_under_torchrun(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name, value in {"RANK": "0", "LOCAL_RANK": "0", "WORLD_SIZE": "2", "TORCHELASTIC_RUN_ID": "x"}.items():
        monkeypatch.setenv(name, value)
    assert main(["train", "--solver", "solver.prototxt", "--gpu", "0,1"]) == 2
    assert "leave out --gpu" in capsys.readouterr().err
