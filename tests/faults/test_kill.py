"""A command that is killed while it writes: each file is missing or complete, and the next run removes the rest."""

import multiprocessing
import os
import signal
import sys
from pathlib import Path

import pytest

from faults.commands import CASES
from netspec.data.database import open_reader
from netspec.load import load_solver
from netspec.solver.snapshot import read_state

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="has no SIGKILL")]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()


def run(name: str, sync: int) -> None:
    """Run a command that is killed when a file is synced to disk for that time."""
    left = iter(range(1, sync))
    os.fsync = lambda descriptor: next(left, 0) or os.kill(os.getpid(), signal.SIGKILL)
    sys.exit(CASES[name].main(list(CASES[name].words)))


def killed_at(name: str, sync: int) -> bool:
    """Run a command in a process of its own. Returns whether it was killed."""
    # A fork of pytest would inherit locks of its threads.
    process = multiprocessing.get_context("forkserver").Process(target=run, args=(name, sync))
    process.start()
    process.join()
    return process.exitcode == -signal.SIGKILL


def leftovers() -> list[Path]:
    return list(Path("out").glob(".*.unfinished"))


def test_a_training_killed_during_a_snapshot_can_be_resumed() -> None:
    CASES["train"].prepare()
    for sync in range(1, 16, 2):  # the files of two snapshots and their folder
        assert killed_at("train", sync)
        states = sorted(Path("out").glob("*.solverstate"), key=lambda path: int(path.stem.rpartition("_")[2]))
        assert all(Path(read_state(state).learned_net).is_file() for state in states)
        if states:
            solver = load_solver("solver.prototxt", snapshot=states[-1])
            assert solver.iteration == int(states[-1].stem.rpartition("_")[2])
            solver.close()
    assert states
    assert not killed_at("train", 1000)
    assert not leftovers()


def test_a_database_of_a_killed_command_is_missing() -> None:
    CASES["convert"].prepare()
    assert killed_at("convert", 1)
    assert leftovers()
    assert not Path("out/db").exists()
    assert not killed_at("convert", 1000)
    assert len(open_reader("out/db")) == 80
    assert not leftovers()
