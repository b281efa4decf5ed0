"""Standard output that is closed, full, missing, or cannot encode a character."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT

CODE = (Path(__file__).parent / "programs" / "standard_output.py").read_text()


def printed(text: str, stdout: int, **variables: str) -> subprocess.CompletedProcess[bytes]:
    words = [sys.executable, "-c", CODE, text]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "", **variables}
    return subprocess.run(words, stdout=stdout, stderr=subprocess.PIPE, env=environment)


@pytest.mark.parametrize("text", ["short", "long" * 10000], ids=["short", "long"])
def test_a_closed_pipe_ends_a_command_quietly(text: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = printed(text, writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has /dev/full")
def test_a_full_standard_output_is_reported_in_one_line() -> None:
    with open("/dev/full", "wb") as full:
        done = printed("short", full.fileno())
    assert (done.returncode, done.stderr) == (1, b"standard output: No space left on device\n")


def test_characters_that_the_encoding_lacks_are_escaped() -> None:
    done = printed("caf\udce9 \u2588", subprocess.PIPE, PYTHONIOENCODING="latin-1", PYTHONUTF8="1")
    assert (done.returncode, done.stdout) == (0, b"caf\\udce9 \\u2588\n")


@pytest.mark.skipif(sys.platform == "win32", reason="a shell's >&-")
def test_a_command_without_standard_output_succeeds() -> None:
    words = ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-c", CODE, "short"]
    done = subprocess.run(words, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert (done.returncode, done.stderr) == (0, b"")
