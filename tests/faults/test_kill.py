"""A command that is killed while it writes: each file is missing or complete, and the next run removes the rest."""

import os
import signal
from pathlib import Path

import pytest

import netspec.files.whole_file
from faults.commands import CASES, Case
from netspec.data.database import open_reader
from netspec.load import load_solver
from netspec.solver.snapshot import read_state

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()


def killed_at(case: Case, sync: int) -> bool:
    """Run a command in a fork that is killed when a file is synced to disk for that time. Returns whether it was."""
    child = os.fork()
    if not child:
        left = iter(range(1, sync))
        os.fsync = lambda descriptor: next(left, 0) or os.kill(os.getpid(), signal.SIGKILL)
        netspec.files.whole_file._swept.clear()  # in this process, but not in new ones
        os._exit(case.main(list(case.words)))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def leftovers() -> list[Path]:
    return list(Path("out").glob(".*.unfinished"))


def test_a_training_killed_during_a_snapshot_can_be_resumed() -> None:
    case = CASES["train"]
    case.prepare()
    for sync in range(1, 16, 2):  # the files of two snapshots and their folder
        assert killed_at(case, sync)
        states = sorted(Path("out").glob("*.solverstate"), key=lambda path: int(path.stem.rpartition("_")[2]))
        assert all(Path(read_state(state).learned_net).is_file() for state in states)
        if states:
            solver = load_solver("solver.prototxt", snapshot=states[-1])
            assert solver.iteration == int(states[-1].stem.rpartition("_")[2])
            solver.close()
    assert states
    assert not killed_at(case, 1000)
    assert not leftovers()


def test_a_database_of_a_killed_command_is_missing() -> None:
    case = CASES["convert"]
    case.prepare()
    assert killed_at(case, 1)
    assert leftovers()
    assert not Path("out/db").exists()
    assert not killed_at(case, 1000)
    assert len(open_reader("out/db")) == 80
    assert not leftovers()
