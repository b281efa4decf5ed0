"""pyright, as a test, so that it runs in parallel with the others."""

import subprocess
import sys

import pytest

from paths import ROOT


@pytest.mark.slow
def test_pyright_finds_no_error() -> None:
    words = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable]
    found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr
