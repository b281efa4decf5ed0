"""``lmdb-build views``."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from lmdb_build.cli.arguments import size
from lmdb_build.cli.bar import bar
from lmdb_build.pairs.runs import folder_runs, index_runs, join_runs
from lmdb_build.views import Batches, Changes, write_views
from netspec.terminal.commands import Commands, WrongUsage, refuse
from netspec.terminal.options import above_zero, seed


def add_to(commands: Commands) -> None:
    """Add the command."""
    add = commands.add("views", _views, "make two views of each place, in batches of different places").add_argument
    add("folders", type=Path, nargs="*", metavar="FOLDER", help="runs of images; or --index, or both")
    add("--out", type=Path, required=True, help="folder for the views; the list is OUT.txt")
    add("--index", type=Path, metavar="CSV", help="a table of frames, with --track and --time")
    add("--track", metavar="COLUMN", help="column of --index that names the run")
    add("--time", metavar="COLUMN", help="column of --index with the position in the run")
    add("--step", type=above_zero, default=1.0, help="seconds between two images of a FOLDER (1)")
    add("--batches", type=int, default=400, help="how many batches (400)")
    add("--size", type=int, default=48, help="pairs per batch, each of a different place (48)")
    add("--per-track", type=int, default=8, help="at most this many of them from one run (8)")
    add("--apart", type=float, default=4.0, help="least distance of places of one run, in seconds (4)")
    add("--window", type=float, default=float("inf"), help="places of one run come from so many seconds of it (all)")
    add("--max-gap", type=float, default=1.0, help="largest distance of the two images of a place, in seconds (1)")
    add("--other", type=float, default=0.4, help="share of pairs that use two images of a place (0.4)")
    add("--negatives", type=float, default=0.0, help="share of pairs of two places, for ContrastiveLoss (0)")
    add("--viewpoint", type=float, default=1.0, help="how many times as strong zoom, turn and perspective are (1)")
    add("--calm", type=float, default=0.0, help="share of views that keep their colors and what they show (0)")
    add("--view-size", type=size, default=(128, 96), help="size of a view (128x96)")
    add("--seed", type=seed, default=1, help="random seed (1)")


def _views(arguments: argparse.Namespace) -> None:
    if not (arguments.folders or arguments.index):
        raise WrongUsage("name folders, or --index, or both")
    if not arguments.folders:
        refuse(arguments, ("step",), "is for folders; --time says when the images of --index were taken")
    if not arguments.index:
        refuse(arguments, ("track", "time"), "is a column of --index")
    elif not (arguments.track and arguments.time):
        raise WrongUsage("--index needs --track and --time")
    tables = [arguments.index.parent] if arguments.index else []
    root = Path(os.path.commonpath([folder.resolve() for folder in arguments.folders + tables]))
    parts = [folder_runs(arguments.folders, root, arguments.step)] if arguments.folders else []
    if arguments.index:
        parts.append(index_runs(arguments.index, root, arguments.track, arguments.time))
    runs = join_runs(parts)
    batches = Batches(
        arguments.batches,
        arguments.size,
        arguments.per_track,
        arguments.apart,
        arguments.max_gap,
        arguments.other,
        arguments.negatives,
        arguments.window,
    )
    changes = Changes(arguments.viewpoint, arguments.calm)
    path = write_views(runs, batches, changes, arguments.view_size, root, arguments.out, arguments.seed, bar)
    made = f"{arguments.batches} batches of {arguments.size} pairs"
    print(f"{path}: {made}; the names of images in it are relative to {path.parent}/")
