"""The Markdown files: their blocks, the commands in them as a shell reads them, and how commands and snippets run."""

import multiprocessing
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from paths import ROOT

DOCUMENTS = [
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "README.md", *sorted(ROOT.glob("*/README.md")), *sorted(ROOT.glob("docs/**/*.md")))
]
# What a command may begin with, and where its main() is, if the pages' test runs it.
PROGRAMS = {
    "netspec": "netspec.cli",
    "lmdb-build": "lmdb_build.cli",
    "loopclosure": "loopclosure.cli",
    "torchrun": "torch.distributed.run",
    "tools/bench": "",
    "tools/docs": "",
    "tools/quickstart": "",
    "tools/run_tests": "",
    "benchmarks/gpu_steps": "",
    "python3": "",
    "pip": "",
}
# Imported once; each command and snippet then starts from there. It has a process of its own, as in a shell.
PRELOADED = [
    *("torch", "cv2", "scipy.optimize", "scipy.stats", "matplotlib.pyplot", "sklearn.cluster", "netspec"),
    *filter(None, PROGRAMS.values()),
]
SHELL = """
set -eu
source() { :; }
cd() { mkdir -p "$1" && builtin cd "$1"; }
record() { printf '%s\\0' $(($# + 1)) "$PWD" "$@" >&3; }
"""


@dataclass(frozen=True)
class Block:
    """A fenced block: where it begins, its language, its text; by the line before: its file, that it is not run."""

    where: str
    language: str
    text: str
    file: str | None
    not_run: bool


@dataclass(frozen=True)
class Command:
    """The words of a command, and the folder in which they are typed."""

    words: tuple[str, ...]
    folder: Path


def blocks(document: str) -> list[Block]:
    """Return the fenced blocks of a document, in order."""
    text = (ROOT / document).read_text()
    found = []
    for fence in re.finditer(r"^```([^\n`]*)\n(.*?)^```$", text, re.M | re.S):
        where = f"{document}:{text.count(chr(10), 0, fence.start()) + 2}"
        file = re.search(r"`([\w.]+)`[^`]*:\s*$", text[: fence.start()])
        not_run = re.search(r"<!-- not run: .+ -->\n$", text[: fence.start()])
        found.append(Block(where, fence[1], fence[2], file and file[1], bool(not_run)))
    return found


def commands(text: str, folder: Path) -> list[Command]:
    """Have a shell read a block in a folder; return the commands that it would run, in the order in which it would.

    Variables, loops and patterns are the shell's. Raises AssertionError for what is no command of ours.
    """
    functions = "".join(f'{name}() {{ record {name} "$@"; }}\n' for name in PROGRAMS)
    record = folder / ".commands"
    script = f'exec 3>"{record}"\n{functions}{SHELL}{text}'
    done = subprocess.run(["bash", "-c", script], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{text}\n{done.stderr}"
    words = iter(record.read_text().split("\0"))
    record.unlink()
    found = []
    while count := next(words):
        where, *command = (next(words) for _ in range(int(count)))
        found.append(Command(tuple(command), Path(where)))
    return found


def run(command: Command, log: Path) -> int | None:
    """Run a command of ours; return its exit status, None if it does not end. What it says goes to ``log``."""
    return _status(_main, command.words, command.folder, log)


def run_snippet(text: str, folder: Path, log: Path) -> int | None:
    """Run Python source in a folder; return as :func:`run`."""
    return _status(_snippet, text, folder, log)


def _status(function: Callable[[Any], None], what: object, folder: Path, log: Path) -> int | None:
    """Call a function in a process of its own, in which torch and our modules have been imported already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    process = context.Process(target=_call, args=(function, what, folder, log, multiprocessing.get_start_method()))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        process.start()
    process.join(300)
    if process.exitcode is None:
        process.kill()
    return process.exitcode


def _call(function: Callable[[Any], None], what: object, folder: Path, log: Path, usual: str) -> None:
    multiprocessing.set_start_method(usual, force=True)  # of processes of its own, as where it is typed
    os.chdir(folder)
    os.environ["XDG_CACHE_HOME"] = str(folder / ".cache")
    out, nothing = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), os.open(os.devnull, os.O_RDONLY)
    for new, standard in ((nothing, 0), (out, 1), (out, 2)):
        os.dup2(new, standard)
    function(what)


def _main(words: tuple[str, ...]) -> None:
    sys.argv = list(words)
    sys.exit(import_module(PROGRAMS[words[0]]).main(list(words[1:])))


def _snippet(text: str) -> None:
    exec(compile(text, "snippet", "exec"), {"__name__": "__main__"})
