"""``lmdb-build compare``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from netspec.terminal.commands import Commands


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("compare", _compare, "train nets on the same pairs and print the table that compares them")
    p.add_argument("solvers", nargs="+", metavar="SOLVER", help="solver prototxt files of Siamese nets")
    p.add_argument(
        "--train",
        action="store_true",
        default=True,
        help="the default; --no-train evaluates the snapshots of an earlier training",
    )
    p.add_argument("--out", type=Path, default=Path("out/compare"), help="folder for all files (default: out/compare)")
    p.add_argument("--gpu", default="", help="the number of the GPU to use (default: the CPU)")


def _compare(arguments: argparse.Namespace) -> None:
    from lmdb_build.compare import compare  # which loads the plotting library

    shown: list[tqdm] = []  # the bar of the training, on a terminal

    def say(line: str) -> None:
        tqdm.write(line, file=sys.stderr)
        sys.stderr.flush()

    def step(done: int, total: int, loss: str) -> None:
        if not sys.stderr.isatty():
            say(f"Iteration {done} of {total}, loss = {loss}")
            return
        if done == 0:
            shown[:] = [tqdm(total=total, desc="train", unit="", leave=False)]
        for bar in shown:
            bar.set_postfix_str(f"loss {loss}", refresh=False)
            bar.update(done - bar.n)
            if done == total:
                bar.close()

    table, files = compare(arguments.solvers, arguments.out, arguments.train, arguments.gpu, say, step)
    print(table)
    for path in files:
        say(f"wrote {path}")
