"""``lmdb-build walk``, which renders images."""

from __future__ import annotations

import argparse
from pathlib import Path

from lmdb_build.walk.sequence import Walk, write_walk
from netspec.terminal.commands import WrongUsage
from netspec.terminal.output import bar
from netspec.terminal.parser import Commands, seed


def _size(text: str) -> tuple[int, int]:
    """Read ``WIDTHxHEIGHT``."""
    width, cross, height = text.partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f'expected WIDTHxHEIGHT such as 320x240, found "{text}"')
    return int(width), int(height)


def add_commands(commands: Commands) -> None:
    """Add ``walk``."""
    parser = commands.add_parser("walk", _walk, help="render walks through textured rooms, as TUM RGB-D sequences")
    parser.add_output("out", folder=True, type=Path, metavar="OUT", help="folder for the sequences walk_1, walk_2, ...")
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
