"""``lmdb-build views``."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from lmdb_build.cli.arguments import size
from lmdb_build.pairs.runs import folder_runs, index_runs, join_runs
from lmdb_build.views import Batches, Changes, write_views
from loopclosure.errors import InputError
from loopclosure.places.source import Source, read_source
from netspec.terminal.commands import Commands, above_zero, refuse, seed
from netspec.terminal.output import bar


def add_to(commands: Commands) -> None:
    """Add the command."""
    add = commands.add("views", _views, "make two views of each place, in batches of different places").add_argument
    source = "a folder of images, a run; or index:CSV,track=COLUMN,time=COLUMN, a table of frames of several runs"
    add("sources", type=_source, nargs="+", metavar="SOURCE", help=source)
    add("--out", type=Path, required=True, help="folder for the views; the list is OUT.txt")
    add("--step", type=above_zero, default=1.0, help="seconds between two images of a folder (1)")
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


def _source(text: str) -> Source:
    try:
        found = read_source(text, {"": (), "index": ("track", "time")})
    except InputError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None
    if found.kind and len(found.settings) < 2:
        raise argparse.ArgumentTypeError(f"{text} needs ,track=COLUMN,time=COLUMN")
    return found


def _views(arguments: argparse.Namespace) -> None:
    sources: list[Source] = arguments.sources
    root = Path(os.path.commonpath([(each.path.parent if each.kind else each.path).resolve() for each in sources]))
    if all(each.kind for each in sources):
        refuse(arguments, ("step",), "is for folders; a table has the times of its images")
    parts = []
    for each in sources:
        if each.kind:
            parts.append(index_runs(each.path, root, each.settings["track"], each.settings["time"]))
        else:
            parts.append(folder_runs([each.path], root, arguments.step))
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
