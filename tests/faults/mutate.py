"""Damage files at random; check that every reader ends with its own error, within seconds and with little memory.

    python tests/faults/mutate.py [--tries 1000] [--seed 0] [--keep FOLDER] [FORMAT ...]

Allowed ends are success and SpecError or InputError. Counted as faults are any other exception (MemoryError above 1 GB
more than at the start among them), a process that dies, and a read that computes for more than 10 s or
takes two minutes. With ``--keep`` the inputs that were faults are written to a folder. POSIX only: the readers run in
forks of this process.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import signal
import sys
import tempfile
import traceback
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import cv2  # noqa: E402
import torch  # noqa: E402

from faults.formats import FORMATS, Format  # noqa: E402
from loopclosure.errors import InputError  # noqa: E402
from netspec import log  # noqa: E402
from netspec.errors import SpecError  # noqa: E402

MEMORY = 1 << 30  # bytes
SECONDS = 10
WORDS = (
    *(b"9" * 5000, b"\x00", b"\xff", b"\x7f\xff\xff\xff", b"\xff" * 8, b"\x00" * 8),
    *(b"-1", b"1e999", b"nan", b" ", b"\n", b"\xc3"),
)


def mutant(data: bytes, draw: random.Random) -> bytes:
    """Return a damaged copy."""
    made = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 4, 16))):
        at = draw.randrange(len(made) + 1)
        kind = draw.randrange(7)
        if kind == 0:
            del made[at:]
        elif kind == 1:
            del made[at : at + draw.choice((1, 2, 8, 100))]
        elif kind == 2:
            word = draw.choice(WORDS)
            made[at : at + len(word)] = word
        elif kind == 3:
            made[at:at] = draw.choice(WORDS)
        elif kind == 4:
            start = draw.randrange(len(made) + 1)
            made[at:at] = made[start : start + draw.choice((1, 8, 64))]
        elif kind == 5:
            made[at : at + 1] = bytes([draw.randrange(256)])
        elif at < len(made):
            made[at] ^= 1 << draw.randrange(8)
    return bytes(made)


def ending(form: Format, folder: Path, data: bytes) -> str:
    """Read the bytes; return "" or a description of the failure."""
    path = folder / f"x{form.suffix}"
    (path / form.inside if form.inside else path).write_bytes(data)
    try:
        form.read(path)
    except (SpecError, InputError) as fault:
        return "" if "\n" not in str(fault) else f"an error of several lines: {fault!r}"
    except BaseException as fault:
        place = traceback.extract_tb(fault.__traceback__)
        mine = [f for f in place if str(ROOT) in f.filename and "/.venv/" not in f.filename][-1]
        return f"{type(fault).__name__} at {Path(mine.filename).name}:{mine.lineno}: {str(fault)[:80]}"
    return ""


def _limit() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 1)
    os.dup2(null, 2)


def run(form: Format, folder: Path, inputs: list[bytes]) -> dict[int, str]:
    """Read all inputs, in forks that end with the first fault; return the faults by number."""
    faults: dict[int, str] = {}
    first = 0
    while first < len(inputs):
        here, there = os.pipe()
        child = os.fork()
        if not child:
            _limit()
            for i in range(first, len(inputs)):
                os.write(there, b"%d\n" % i)
                signal.setitimer(signal.ITIMER_PROF, SECONDS)  # kills the process even on a busy machine
                signal.alarm(12 * SECONDS)
                if said := ending(form, folder, inputs[i]):
                    os.write(there, f"{i} {said}\n".encode(errors="replace"))
                    os._exit(1)
            os._exit(0)
        os.close(there)
        with os.fdopen(here, errors="replace") as pipe:
            *_, last = ["0", *pipe]
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if not status:
            break
        number, _, said = last.partition(" ")
        name = (
            "more than 10 s"
            if -status in (signal.SIGPROF, signal.SIGALRM)
            else f"killed by {signal.Signals(-status).name}"
            if status < 0
            else said
        )
        faults[int(number)] = name.strip()
        first = int(number) + 1
    return faults


def main(words: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("formats", nargs="*", metavar="FORMAT", default=[], help=", ".join(FORMATS))
    parser.add_argument("--tries", type=int, default=1000, help="of each format (1000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where inputs that are faults are kept")
    a = parser.parse_args(words)
    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    log.logger.disabled = True
    wrong = 0
    with tempfile.TemporaryDirectory() as place:
        for name in a.formats or FORMATS:
            form = FORMATS[name]
            data = form.good(Path(place))
            if said := ending(form, Path(place), form.close(form.open(data))):
                raise SystemExit(f"{name}: the good file is a fault: {said}")
            draw = random.Random(f"{name}/{a.seed}")
            inputs = [mutant(data, draw) for _ in range(a.tries // 2)]
            inputs += [form.close(mutant(form.open(data), draw)) for _ in range(a.tries - len(inputs))]
            faults = run(form, Path(place), inputs)
            print(f"{name}: {len(faults)} of {len(inputs)}", flush=True)
            for said, count in Counter(faults.values()).most_common(8):
                print(f"    {count} {said}", flush=True)
            wrong += len(faults)
            if a.keep:
                a.keep.mkdir(parents=True, exist_ok=True)
                for i in faults:
                    (a.keep / f"{name.replace(' ', '_')}.{a.seed}.{i}").write_bytes(inputs[i])
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
