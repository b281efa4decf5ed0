"""What a program sets before torch is loaded."""

import os
import re
import subprocess
import sys

import pytest

from paths import ROOT

pytestmark = pytest.mark.slow

VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")


def spins(**variables: str) -> set[str]:
    """How long threads spin, as each OpenMP runtime that a command loads tells it: GNU's in turns, LLVM's in ms."""
    others = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    ran = subprocess.run(
        [sys.executable, "-m", "netspec", "layers"], cwd=ROOT, capture_output=True, text=True, check=True,
        env={**others, "OMP_DISPLAY_ENV": "verbose", **variables},
    )  # fmt: skip
    found = set(re.findall(r"(?:GOMP_SPINCOUNT|KMP_BLOCKTIME)\s*=\s*'(\d+)", ran.stderr))
    if not found:
        pytest.skip("torch's OpenMP runtime does not tell how its threads wait")
    return found


def test_idle_threads_of_a_command_sleep_soon() -> None:
    assert spins() <= {"2000", "0"}


def test_settings_of_the_user_are_kept() -> None:
    assert spins(GOMP_SPINCOUNT="5", KMP_BLOCKTIME="5") == {"5"}
