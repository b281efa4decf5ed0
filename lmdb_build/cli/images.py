"""``lmdb-build walk`` and ``views``: images to begin with."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from lmdb_build.pairs.runs import folder_runs, index_runs, join_runs
from lmdb_build.views import Batches, Changes, write_views
from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.errors import InputError
from loopclosure.places.source import Source, read_source
from netspec.terminal.commands import WrongUsage, above_zero, refuse, seed
from netspec.terminal.output import bar


def _size(text: str) -> tuple[int, int]:
    """Read ``WIDTHxHEIGHT``."""
    width, cross, height = text.partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f'expected WIDTHxHEIGHT such as 320x240, found "{text}"')
    return int(width), int(height)


def _source(text: str) -> Source:
    try:
        found = read_source(text, {"": (), "index": ("track", "time")})
    except InputError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None
    if found.kind and len(found.settings) < 2:
        raise argparse.ArgumentTypeError(f"{text} needs ,track=COLUMN,time=COLUMN")
    return found


def _views(arguments: argparse.Namespace) -> None:
    sources: list[Source] = arguments.source
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
    batches = Batches(arguments.batches, arguments.size, arguments.window)
    changes = Changes(arguments.viewpoint, arguments.calm)
    path = write_views(runs, batches, changes, arguments.view_size, root, arguments.out, arguments.seed, bar)
    made = f"{arguments.batches} batches of {arguments.size} pairs"
    print(f"{path}: {made}; the names of images in it are relative to {path.parent}/")


def _walk(arguments: argparse.Namespace) -> None:
    if not 1 <= arguments.sequences <= 999:
        raise WrongUsage("--sequences must be 1 to 999")
    for number in range(1, arguments.sequences + 1):
        walk = Walk(
            frames=arguments.frames,
            width=arguments.size[0],
            height=arguments.size[1],
            laps=arguments.laps,
            rooms=arguments.rooms,
            depth=arguments.depth,
            seed=1000 * arguments.seed + number,
            start_s=10_000.0 * number,
        )
        folder = arguments.out / f"walk_{number}"
        for _ in bar(write_walk(folder, walk), folder.name, walk.frames):
            pass
        print(f"{folder}: {walk.frames} images, {walk.laps} laps of {walk.rooms} rooms")


WALK = (
    ("OUT", Path, None, "folder for the sequences walk_1, walk_2, ..."),
    ("--sequences N", int, 1, "number of sequences, each in its own house"),
    ("--frames N", int, 400, "images per sequence"),
    ("--size WxH", _size, (320, 240), "size of an image (default: 320x240)"),
    ("--laps N", int, 3, "laps through the house"),
    ("--depth", bool, False, "write depth images too, in TUM's form"),
    ("--rooms N", int, 4, "rooms per house, an even number"),
    ("--seed N", seed, 1, "random seed"),
)
SOURCE = "a folder of images, a run; or index:CSV,track=COLUMN,time=COLUMN, a table of frames of several runs"
VIEWS = (
    ("SOURCE...", _source, None, SOURCE),
    ("--out FOLDER", Path, ..., "folder for the views; the list is FOLDER.txt"),
    ("--step S", above_zero, 1.0, "seconds between two images of a folder"),
    ("--batches N", int, 400, "how many batches"),
    ("--size N", int, 48, "pairs per batch, each of a different place"),
    ("--window S", float, float("inf"), "places of one run come from so many seconds of it (default: all)"),
    ("--viewpoint X", float, 1.0, "how many times as strong zoom, turn and perspective are"),
    ("--calm SHARE", float, 0.0, "share of views that keep their colors and what they show"),
    ("--view-size WxH", _size, (128, 96), "size of a view (default: 128x96)"),
    ("--seed N", seed, 1, "random seed"),
)
COMMANDS = (
    ("walk", _walk, "render a synthetic walk through textured rooms, as TUM RGB-D sequences", WALK),
    ("views", _views, "make two views of each place, in batches of different places", VIEWS),
)
