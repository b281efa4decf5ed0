"""How idle OpenMP threads wait in a process of netspec's, where it is too late to choose, and what is said of it."""

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
from netspec.check.bug_report import bug_report
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


@pytest.mark.parametrize("choice", ["OMP_WAIT_POLICY=ACTIVE", "GOMP_SPINCOUNT=5", "KMP_BLOCKTIME=infinite"])
def test_the_users_own_choice_is_left(choice: str) -> None:
    name, value = choice.split("=")
    assert python("-c", f"import netspec; {SHOW}", **{name: value}).stdout.strip() == choice


def test_where_torch_is_there_already_it_is_too_late() -> None:
    assert python("-c", f"import netspec, torch; {SHOW}").stdout.split() == [
        "OMP_WAIT_POLICY=PASSIVE",
        "GOMP_SPINCOUNT=2000",
    ]
    assert python("-c", f"import torch, netspec; {SHOW}").stdout.strip() == ""


HOW = "import netspec.process.waiting; print(netspec.process.waiting.how()); print(netspec.process.waiting.too_late(2))"


@pytest.mark.parametrize(
    ("first", "variables", "how", "too_late"),
    [
        ("netspec", {}, "OMP_WAIT_POLICY=PASSIVE, GOMP_SPINCOUNT=2000", False),
        ("torch", {}, "the runtime's own way: torch was imported before netspec", True),
        ("torch", {"GOMP_SPINCOUNT": "5"}, "GOMP_SPINCOUNT=5", False),
    ],
)
def test_how_threads_wait_is_known(first: str, variables: dict[str, str], how: str, too_late: bool) -> None:
    found = python("-c", f"import {first}; {HOW}", **variables).stdout.split("\n")
    assert found[0] == how
    assert found[1].startswith("torch was imported before netspec") == too_late


@pytest.fixture
def torch_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "_torch_came_first", True)


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
    said = [line for line in caplog.messages if "torch was imported before netspec" in line]
    assert len(said) == times
    assert all(line.endswith("or set OMP_WAIT_POLICY=PASSIVE and GOMP_SPINCOUNT=2000") for line in said)
