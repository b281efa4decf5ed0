"""kill.py, which kills commands while they write, with few kills."""

import sys
from pathlib import Path

import pytest

import forked

pytestmark = pytest.mark.slow


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_killed_commands_leave_complete_files_and_no_process(tmp_path: Path) -> None:
    kills = "2"  # one at any time, one while a file is written
    done = forked.run(forked.script, Path(__file__).with_name("kill.py"), ["--kills", kills], folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) >= 8
    assert all("0 broken or lost, 0 orphans, 0 leftovers" in line for line in lines)
