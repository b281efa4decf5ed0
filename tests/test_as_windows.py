"""Commands run without what Windows lacks; tests/as_windows takes it away on Linux."""

import os
import subprocess
import sys

import pytest

from paths import ROOT

FOLDER = ROOT / "tests" / "as_windows"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="it is taken away from Linux")
def test_commands_run_without_fork_fcntl_and_links() -> None:
    """A file that is opened without naming an encoding is an error, too: on Windows it would not be UTF-8."""
    paths = os.pathsep.join([str(FOLDER), str(ROOT)])
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "as_windows/checks.py"]
    done = subprocess.run(
        command,
        cwd=ROOT / "tests",
        env={**os.environ, "PYTHONPATH": paths, "PYTHONWARNDEFAULTENCODING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
