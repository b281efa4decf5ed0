"""SIGINT, SIGTERM and a second signal: a command ends with one line and the status 128 + the number."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT

pytestmark = pytest.mark.slow

CODE = """
import sys, time
from netspec.terminal.commands import run
from netspec.terminal.parser import Commands, Parser

def endless(arguments):
    try:
        print("begun", flush=True)
        while True:
            time.sleep(0.01)
    finally:
        print("ending", flush=True)
        time.sleep({cleaning})

parser = Parser()
Commands(parser).add_parser("endless", endless, help="")
sys.exit(run(parser, ["endless"]))
"""
IMPORTED = """
import sys

class Slow:
    def find_spec(self, name, path, target=None):
        if name == "{package}.cli":
            import time
            print("begun", flush=True)
            time.sleep(60)

sys.meta_path.insert(0, Slow())
from {package}.__main__ import main
sys.exit(main())
"""


def start(*words: str) -> subprocess.Popen[str]:
    environment, pipe = {**os.environ, "PYTHONPATH": f"{ROOT}:."}, subprocess.PIPE
    words = words if words[1:] else ("-c", *words)
    process = subprocess.Popen([sys.executable, *words], stdout=pipe, stderr=pipe, text=True, env=environment)
    assert line_of(process) == "begun"
    return process


def line_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_command_with_one_line_and_its_status(number: int) -> None:
    process = start(CODE.format(cleaning=0))
    process.send_signal(number)
    _, said = process.communicate(timeout=300)
    assert (process.returncode, said) == (128 + number, "interrupted\n")


@pytest.mark.parametrize("package", ["netspec", "loopclosure", "lmdb_build"])
def test_a_signal_during_imports_ends_with_one_line_and_its_status(package: str) -> None:
    process = start(IMPORTED.format(package=package))
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=300)
    assert (process.returncode, said) == (143, "interrupted\n")


def test_a_second_signal_ends_a_command_at_once() -> None:
    process = start(CODE.format(cleaning=60))
    process.send_signal(signal.SIGINT)
    assert line_of(process) == "ending"
    process.send_signal(signal.SIGTERM)
    assert process.wait(300) == 143


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for processes in /proc")
def test_worker_processes_end_with_their_killed_parent(tmp_path: Path) -> None:
    code = (
        "import os, sys, time\n"
        "from lmdb_build.databases import _Workers\n"
        "with _Workers(3) as workers:\n"
        "    print(*[worker.pid for worker in workers._pool._processes.values()], flush=True)\n"
        "    time.sleep(60)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment)
    workers = line_of(process).split()
    assert len(workers) == 3
    process.kill()
    process.wait()
    for _ in range(5000):
        alive = [number for number in workers if _is_alive(number)]
        if not alive:
            return
        signal.sigtimedwait([], 0.02)
    pytest.fail(f"{alive} are still alive")


def _is_alive(number: str) -> bool:
    try:
        return Path("/proc", number, "stat").read_text().split()[2] not in "ZX"
    except OSError:
        return False
