"""What a command prints where nobody reads it, where there is no room, and names that are not in the encoding."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT

PACKAGES = {"netspec": "netspec.terminal.commands", "loopclosure": "loopclosure.cli.run"}
CODE = """
import argparse, sys, types
from {package}.__main__ import program
from {module} import Commands, run

def main(words):
    parser = argparse.ArgumentParser()
    Commands(parser).add("say", lambda arguments: print(*words), "")
    return run(parser, ["say"])

sys.modules["commands"] = types.SimpleNamespace(main=main)
sys.exit(program("commands", sys.argv[1:]))
"""


def printed(package: str, text: str, stdout: int, **variables: str) -> subprocess.CompletedProcess[bytes]:
    words = [sys.executable, "-c", CODE.format(package=package, module=PACKAGES[package]), text]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "", **variables}
    return subprocess.run(words, stdout=stdout, stderr=subprocess.PIPE, env=environment)


@pytest.mark.parametrize("package", PACKAGES)
@pytest.mark.parametrize("text", ["short", "long" * 10000], ids=len)
def test_a_closed_pipe_ends_a_command_quietly(package: str, text: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = printed(package, text, writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has /dev/full")
@pytest.mark.parametrize("package", PACKAGES)
def test_no_room_for_what_is_printed_is_one_line(package: str) -> None:
    with open("/dev/full", "wb") as full:
        done = printed(package, "short", full.fileno())
    assert (done.returncode, done.stderr) == (1, b"standard output: No space left on device\n")


@pytest.mark.parametrize("package", PACKAGES)
def test_what_the_encoding_does_not_have_is_escaped(package: str) -> None:
    done = printed(package, "caf\udce9 \u2588", subprocess.PIPE, PYTHONIOENCODING="latin-1", PYTHONUTF8="1")
    assert (done.returncode, done.stdout) == (0, b"caf\\udce9 \\u2588\n")


@pytest.mark.skipif(sys.platform == "win32", reason="a shell's >&-")
@pytest.mark.parametrize("package", PACKAGES)
def test_without_standard_output_a_command_is_done(package: str) -> None:
    code = CODE.format(package=package, module=PACKAGES[package])
    words = ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-c", code, "short"]
    done = subprocess.run(words, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert (done.returncode, done.stderr) == (0, b"")
