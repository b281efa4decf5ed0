"""``lmdb-build walk`` and ``views``, which generate images."""

from __future__ import annotations

import argparse
from pathlib import Path

from lmdb_build.pairs.list_file import common_folder
from lmdb_build.pairs.runs import folder_runs, index_runs, join_runs
from lmdb_build.views import Batches, Changes, write_views
from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.errors import InputError
from loopclosure.places.source import Source, read_source
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.output import bar
from netspec.terminal.parser import Commands, above_zero, seed


def add_commands(commands: Commands) -> None:
    """Add ``walk`` and ``views``."""
    _add_walk(commands)
    _add_views(commands)


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


def _add_views(commands: Commands) -> None:
    parser = commands.add_parser("views", help="generate two views of each place, in batches of different places")
    parser.set_defaults(function=_views)
    parser.add_argument(
        "source",
        nargs="+",
        type=_source,
        metavar="SOURCE",
        help="a folder with the images of a drive; or index:CSV,track=COLUMN,time=COLUMN, a table of several drives",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FOLDER", help="folder for the views; the list is FOLDER.txt"
    )
    parser.add_argument(
        "--step",
        type=above_zero,
        default=1.0,
        metavar="S",
        help="seconds between successive images of a folder (default: %(default)g)",
    )
    parser.add_argument(
        "--batches", type=int, default=400, metavar="N", help="number of batches (default: %(default)s)"
    )
    parser.add_argument(
        "--size",
        type=int,
        default=48,
        metavar="N",
        help="pairs in a batch, each of a different place (default: %(default)s)",
    )
    parser.add_argument(
        "--window",
        type=float,
        default=float("inf"),
        metavar="S",
        help="take the places of a batch from this many seconds of a drive (default: the whole drive)",
    )
    parser.add_argument(
        "--viewpoint",
        type=float,
        default=1.0,
        metavar="X",
        help="strength of zoom, rotation and perspective (default: %(default)g)",
    )
    parser.add_argument(
        "--calm",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="share of the views without color changes and occlusions (default: %(default)g)",
    )
    parser.add_argument(
        "--view-size", type=_size, default=(128, 96), metavar="WxH", help="size of a view (default: 128x96)"
    )
    parser.add_argument("--seed", type=seed, default=1, metavar="N", help="random seed (default: %(default)s)")


def _views(arguments: argparse.Namespace) -> None:
    sources: list[Source] = arguments.source
    root = common_folder([(each.path.parent if each.kind else each.path).resolve() for each in sources])
    if all(each.kind for each in sources):
        refuse(arguments, ("step",), "is for folders; a table has its own times")
    parts = []
    for each in sources:
        if each.kind:
            parts.append(index_runs(each.path, root, each.settings["track"], each.settings["time"]))
        else:
            parts.append(folder_runs([each.path], root, arguments.step))
    runs = join_runs(parts)
    batches = Batches(arguments.batches, arguments.size, arguments.window, arguments.seed)
    changes = Changes(arguments.viewpoint, arguments.calm, arguments.view_size)
    path = write_views(runs, batches, changes, root, arguments.out, bar)
    made = f"{arguments.batches} batches of {arguments.size} pairs"
    print(f"{path}: {made}; its image names are relative to {path.parent}/")


def _add_walk(commands: Commands) -> None:
    parser = commands.add_parser("walk", help="render walks through textured rooms, as TUM RGB-D sequences")
    parser.set_defaults(function=_walk)
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for the sequences walk_1, walk_2, ...")
    parser.add_argument(
        "--sequences",
        type=int,
        default=1,
        metavar="N",
        help="number of sequences, each in its own house (default: %(default)s)",
    )
    parser.add_argument(
        "--frames", type=int, default=400, metavar="N", help="images per sequence (default: %(default)s)"
    )
    parser.add_argument(
        "--size", type=_size, default=(320, 240), metavar="WxH", help="size of an image (default: 320x240)"
    )
    parser.add_argument(
        "--laps", type=int, default=3, metavar="N", help="laps through the house (default: %(default)s)"
    )
    parser.add_argument("--depth", action="store_true", help="also write depth images, in TUM's format")
    parser.add_argument(
        "--rooms", type=int, default=4, metavar="N", help="rooms per house, an even number (default: %(default)s)"
    )
    parser.add_argument("--seed", type=seed, default=1, metavar="N", help="random seed (default: %(default)s)")


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
