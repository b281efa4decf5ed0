"""kill.py, which kills commands while they write, with few kills."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_killed_commands_leave_complete_files_and_no_process(tmp_path: Path) -> None:
    kills = "2"  # one at any time, one while a file is written
    command = [sys.executable, Path(__file__).with_name("kill.py"), "--kills", kills]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) >= 8
    assert all("0 broken or lost, 0 orphans, 0 leftovers" in line for line in lines)
