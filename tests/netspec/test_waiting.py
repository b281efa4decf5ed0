"""How idle OpenMP threads wait in a process of netspec's, and that the user's own choice is left alone."""

import os
import re
import subprocess
import sys

import pytest

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
