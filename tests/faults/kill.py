"""Kill commands repeatedly; check that files are complete and that no process and no other file is left.

    python tests/faults/kill.py [--kills 200] [--seed 0] [COMMAND ...]

Each run is a process of its own that gets SIGKILL: every second run at a random time, the others while a file is being
written, which takes 10 ms longer in these. After each kill the output is read: it must be missing, if no run had
finished yet, or whole, with the content that an undisturbed run writes. At the end the command runs undisturbed, and
nothing may be left but its outputs. POSIX only: runs are forked from this process, which has the imports already.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import matplotlib.pyplot  # noqa: E402, F401  each run would import it again
import torch  # noqa: E402

import lmdb_build.cli  # noqa: E402
import netspec.files.whole_file  # noqa: E402
from faults.commands import CASES, Case, remove_database  # noqa: E402


@dataclass
class Tally:
    """What happened to one command."""

    kills: int = 0
    while_writing: int = 0
    finished: int = 0
    broken: list[str] = field(default_factory=list)
    orphans: int = 0
    leftovers: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        lost = f"{len(self.broken)} broken or lost, {self.orphans} orphans, {len(self.leftovers)} leftovers"
        return f"{self.kills} kills, {self.while_writing} of them while a file was written; {lost}"


def start(case: Case, slowly: bool = False) -> int:
    """Fork a run of the command, without output, in its own session; optionally, it writes files slowly."""
    child = os.fork()
    if child:
        return child
    os.setsid()
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    netspec.files.whole_file._swept.clear()  # in this process, but not in new ones
    sync, status = os.fsync, 1
    if slowly:

        def slow_sync(descriptor: int) -> None:
            time.sleep(0.01)
            sync(descriptor)

        os.fsync = slow_sync
    try:
        status = case.main(list(case.words))
    finally:
        os._exit(status)


def is_over(process: int) -> bool:
    return os.waitpid(process, os.WNOHANG)[0] != 0


def unfinished() -> list[str]:
    return [path.name for path in Path("out").glob(".*.unfinished")]


def has_orphans(session: int, patience: float = 60.0) -> bool:
    """Return whether a session still has processes after ``patience`` seconds, and kill them."""
    end = time.monotonic() + patience
    while True:
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return False
        if time.monotonic() > end:
            os.killpg(session, signal.SIGKILL)
            return True
        time.sleep(0.02)


def kill_repeatedly(case: Case, kills: int, draw: random.Random) -> Tally:
    """Run and kill the command in the working directory; return what was lost."""
    Path("out").mkdir()
    case.prepare()
    began = time.monotonic()
    _, status = os.waitpid(start(case), 0)
    length = time.monotonic() - began
    assert status == 0, f"an undisturbed run ends with {os.waitstatus_to_exitcode(status)}"
    expected = case.check()
    left = {path.name for path in Path("out").iterdir()}
    shutil.rmtree("out")
    Path("out").mkdir()
    tally, was_written = Tally(), False
    while tally.kills < kills:
        remove_database()  # an existing database is never overwritten
        before = set(unfinished())
        in_a_write = tally.kills % 2 == 1
        process = start(case, slowly=in_a_write)
        end = time.monotonic() + (length * 1.5 if in_a_write else draw.uniform(0, length))
        over = False
        while time.monotonic() < end and not over and not (in_a_write and set(unfinished()) - before):
            time.sleep(0.0003)
            over = is_over(process)
        if in_a_write and not over:
            time.sleep(draw.uniform(0, 0.01))
        tally.while_writing += bool(set(unfinished()) - before)
        if over or is_over(process):
            tally.finished += 1
            was_written = True
        else:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
        tally.kills += 1
        tally.orphans += has_orphans(process)
        try:
            found = case.check()
            was_written = was_written and case.main is not lmdb_build.cli.main
            assert found == expected or (found is None and not was_written), "not what an undisturbed run writes"
            was_written = was_written or found is not None
        except Exception as fault:  # any error from reading a broken file
            tally.broken.append(f"{type(fault).__name__}: {fault}")
    remove_database()
    os.waitpid(start(case), 0)
    tally.leftovers = sorted({path.name for path in Path("out").iterdir()} - left)
    return tally


def main(words: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commands", nargs="*", metavar="COMMAND", default=[], help=", ".join(CASES))
    parser.add_argument("--kills", type=int, default=200, help="of each command (200)")
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args(words)
    torch.set_num_threads(1)  # a fork has only one
    lost = False
    for name in a.commands or CASES:
        home = Path.cwd()
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            try:
                tally = kill_repeatedly(CASES[name], a.kills, random.Random(a.seed))
            finally:
                os.chdir(home)
        print(f"{name}: {tally}", *tally.broken[:3], *tally.leftovers[:3], sep="\n  ", flush=True)
        lost |= bool(tally.broken or tally.orphans or tally.leftovers)
    return int(lost)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
