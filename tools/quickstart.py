#!/usr/bin/env python3
"""Install, then run all steps on a synthetic walk: ``python3 tools/quickstart.py [--cpu]``.

Images, labeled pairs, an LMDB, the training of a small net, a table and pictures; then it detects loops with a trained
net, and corrects a path with them. All files go to a new folder: out/quickstart, or out/quickstart-2 and so on if it
exists. The output of the commands is in its quickstart.log. ``--cpu`` installs PyTorch without NVIDIA's libraries.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from install import PROGRAMS, ROOT, install, program

SPLIT = "--train-sequences walk_1,walk_2 --val-sequences walk_3 --train 1600 --val 400 --test 0 --min-gap 1"
CONVERT = "lmdb-build convert -minloglevel 1 -resize_width 64 -resize_height 64"
DEPLOY = "prototxt/many_negatives/siamese_words_256/deploy.prototxt"
WEIGHTS = "prototxt/many_negatives/siamese_words_256/siamese_words_256.caffemodel"
STEPS = {
    "a walk through three houses, three rounds each": [
        "lmdb-build walk walk --sequences 3 --frames 250 --size 160x120 --depth",
    ],
    "pairs of images: the same place, or not (two houses for training, the third for validation)": [
        f"lmdb-build pairs walk/walk_1 walk/walk_2 walk/walk_3 --different-scenes --split sequence {SPLIT} --out pairs",
        "lmdb-build sheet pairs/train.txt pairs.png",
    ],
    "the databases": [f"{CONVERT} walk/ pairs/{split}.txt data/pairs64_{split}_lmdb" for split in ("train", "val")],
    "training, the longest step: one to three minutes": [
        "lmdb-build compare prototxt/small/siamese_8/solver.prototxt --out compare",
    ],
    "loop closure in the third house, with a net that was trained on other places": [
        f"netspec extract {DEPLOY} --weights {WEIGHTS} --blob feat --images walk/walk_3 --out features.npz",
        "loopclosure evaluate walk/walk_3 --method features:features.npz --method thumbnails --out report",
        "loopclosure detect walk/walk_3 --describe features.npz --out loops",
    ],
    "the loops correct odometry that drifts": [
        "loopclosure close walk/walk_3 --loops loops/loops.csv --drift 2 --out closed",
    ],
}


def main() -> int:
    """Run the steps; return the exit status of the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cpu", action="store_true", help="install PyTorch for the CPU alone")
    install(parser.parse_args().cpu)
    names = itertools.chain(["quickstart"], (f"quickstart-{k}" for k in itertools.count(2)))
    folder = next(path for path in (ROOT / "out" / name for name in names) if not path.exists())
    (folder / "data").mkdir(parents=True)
    shutil.copytree(ROOT / "prototxt", folder / "prototxt")
    log = folder / "quickstart.log"
    say(f"In {shown(folder)}:")
    for number, (what, commands) in enumerate(STEPS.items(), 1):
        say(f"{number} of {len(STEPS)}: {what}")
        for command in commands:
            status = call(command, folder, log)
            if status:
                say(f"The quick start stopped; see {shown(log)}")
                return status
    print_results(folder, log)
    return 0


def call(command: str, folder: Path, log: Path) -> int:
    """Run a command of the environment in a folder; its output goes to the log, its messages to the terminal."""
    name, *words = command.split()
    path = os.pathsep.join([str(PROGRAMS), os.environ.get("PATH", "")])
    with log.open("ab") as output:
        return subprocess.call([program(name), *words], cwd=folder, stdout=output, env={**os.environ, "PATH": path})


def print_results(folder: Path, log: Path) -> None:
    """Print what was reached, and where the pictures are."""
    with (folder / "compare" / "table.csv").open(encoding="utf-8", newline="") as file:
        accuracy = 100 * float(next(csv.DictReader(file))["accuracy"])
    found = re.search(r"^position.*?([0-9.]+) before, ([0-9.]+) after", log.read_text("utf-8", "replace"), re.MULTILINE)
    before, after = map(float, found.groups()) if found else (float("nan"), float("nan"))
    out = shown(folder)
    activate = PROGRAMS / "activate"
    print(f"A small net, trained here, labels {accuracy:.0f} of 100 pairs of a new house correctly: ", end="")
    print(out / "compare" / "distances.png")
    print("The loops reduce the error of the path through that house ", end="")
    print(f"from {before:.2f} m to {after:.2f} m: {out / 'closed' / 'paths.png'}")
    print(f"More pictures: {out / 'pairs.png'}, {out / 'compare' / 'losses.png'} ", end="")
    print(f"and the report {out / 'report' / 'report.html'}")
    print(f"What each command printed: {shown(log)}")
    print(f"To continue there: source {shown(activate)} && cd {out}")


def shown(path: Path) -> Path:
    """Return a path as it is printed: relative, if it is below the user's working directory."""
    try:
        return path.relative_to(Path.cwd())
    except ValueError:
        return path


def say(text: str) -> None:
    """Print to the terminal at once."""
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
