"""``lmdb-build compare``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

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

    table, files = compare(arguments.solvers, arguments.out, arguments.train, arguments.gpu, _say)
    print(table)
    for path in files:
        _say(f"wrote {path}")


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
