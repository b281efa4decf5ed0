"""Reads the fenced blocks of Markdown files, and runs them and the commands in them."""

import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

import forked
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
    "python3": "",
    "pip": "",
}
SHELL = """
set -eu
source() { :; }
cd() { mkdir -p "$1" && builtin cd "$1"; }
record() { printf '%s\\0' $(($# + 1)) "$PWD" "$@" >&3; }
"""


@dataclass(frozen=True)
class Block:
    """A fenced block: its line, its language, its text. The line before may name its file or exclude it."""

    where: str
    language: str
    text: str
    file: str | None
    not_run: bool


@dataclass(frozen=True)
class Command:
    """The words of a command, and the folder in which it runs."""

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
    """Run a command of ours; return its exit status, None if it does not end. Its output goes to ``log``."""
    main = PROGRAMS[command.words[0]]
    return forked.wait(forked.start(forked.main, main, command.words, folder=command.folder, out=log))


def run_snippet(text: str, folder: Path, log: Path) -> int | None:
    """Run Python source in a folder; return as :func:`run`."""
    return forked.wait(forked.start(forked.snippet, text, folder=folder, out=log))
