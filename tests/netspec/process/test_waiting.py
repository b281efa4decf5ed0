"""How idle OpenMP threads wait in programs, where it is too late to choose, and what is said of it."""

import logging
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import netspec
from netspec.inspect.check.bug_report import bug_report
from netspec.process import waiting
from paths import ROOT

pytestmark = pytest.mark.slow

VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
SHOW = f"import os; print(*(name + '=' + os.environ[name] for name in {VARIABLES} if name in os.environ))"


def python(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    return subprocess.run(
        [sys.executable, *words], cwd=ROOT, env={**environment, **variables}, capture_output=True, text=True, check=True
    )


def spins(**variables: str) -> set[str]:
    """How long threads spin, as each OpenMP runtime that a command loads tells it: GNU's in turns, LLVM's in ms."""
    told = python("-m", "netspec", "layers", OMP_DISPLAY_ENV="verbose", **variables).stderr
    found = set(re.findall(r"(?:GOMP_SPINCOUNT|KMP_BLOCKTIME)\s*=\s*'(\d+)", told))
    if not found:
        pytest.skip("torch's OpenMP runtime does not tell how its threads wait")
    return found


def test_threads_that_wait_soon_sleep_in_a_command() -> None:
    assert spins() <= {"2000", "0"}  # GNU's runtime counts turns, LLVM's milliseconds
    assert spins(GOMP_SPINCOUNT="5", KMP_BLOCKTIME="5") == {"5"}


PROGRAM = "from netspec.process.programs import set_up; set_up()"
HOW = "from netspec.process import waiting; print(waiting.how()); print(waiting.too_late(2))"


@pytest.mark.parametrize("choice", ["OMP_WAIT_POLICY=ACTIVE", "GOMP_SPINCOUNT=5", "KMP_BLOCKTIME=infinite"])
def test_the_users_own_choice_is_left(choice: str) -> None:
    name, value = choice.split("=")
    shown = python("-c", f"{PROGRAM}; import torch; {SHOW}; {HOW}", **{name: value}).stdout.split("\n")
    assert shown[:3] == [choice, choice, ""]


def test_the_environment_is_as_it_was_once_torch_is_loaded() -> None:
    code = (
        f"{PROGRAM}; import sys; {SHOW}; import torch; {SHOW}; print(torch.__spec__.name, torch.ones(2).sum().item())"
    )
    assert python("-c", code).stdout.split("\n")[:3] == ["", "", "torch 2.0"]


@pytest.mark.parametrize(
    ("before", "how", "too_late"),
    [
        ("import netspec", "the runtime's own way", False),
        (PROGRAM, "OMP_WAIT_POLICY=PASSIVE, GOMP_SPINCOUNT=2000", False),
        (f"import torch; {PROGRAM}", "the runtime's own way: torch was imported before", True),
    ],
)
def test_how_threads_wait_is_known(before: str, how: str, too_late: bool) -> None:
    found = python("-c", f"{before}; {HOW}").stdout.split("\n")
    assert found[0] == how
    assert found[1].startswith("torch was imported before") == too_late


@pytest.fixture
def torch_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "_state", waiting.TOO_LATE)


def test_a_bug_report_says_how_threads_wait() -> None:
    assert f"| idle OpenMP threads | {waiting.how()} |" in bug_report([])


@pytest.mark.usefixtures("torch_first")
@pytest.mark.parametrize(("threads", "times"), [(2, 1), (1, 0)])
def test_the_log_of_a_training_says_once_that_it_was_too_late(
    threads: int, times: int, work_in: Callable[..., Path], caplog: pytest.LogCaptureFixture, monkeypatch
) -> None:
    work_in("train/sgd_step")
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    with caplog.at_level(logging.INFO):
        netspec.load_solver("sgd_step/solver.prototxt", device="cpu").close()
    said = [line for line in caplog.messages if "torch was imported before" in line]
    assert len(said) == times
    assert all(line.endswith("set OMP_WAIT_POLICY=PASSIVE and GOMP_SPINCOUNT=2000") for line in said)
