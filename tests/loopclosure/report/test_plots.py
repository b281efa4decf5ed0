"""The pictures of the report: nothing drawn over the curves, and the caller's matplotlib left as it is."""

import subprocess
import sys

import pytest

from paths import ROOT


@pytest.mark.slow
def test_the_backend_of_the_caller_is_kept(two_laps, tmp_path):
    code = f"""
import sys, matplotlib
matplotlib.use("svg")
import loopclosure.report.table_one
from loopclosure.cli import main
assert main(["evaluate", {str(two_laps)!r}, "--method", "thumbnails", "--out", {str(tmp_path)!r}]) == 0
assert matplotlib.get_backend() == "svg", matplotlib.get_backend()
assert "matplotlib.pyplot" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
