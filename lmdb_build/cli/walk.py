"""``lmdb-build walk``."""

from __future__ import annotations

import argparse
from pathlib import Path

from lmdb_build.cli.arguments import size
from lmdb_build.walk.sequence import Walk, write_walk
from netspec.terminal.commands import Commands, WrongUsage, seed
from netspec.terminal.output import bar

SEASON_S = 1_000_000.0  # between the time stamps of two seasons of one walk


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("walk", _walk, "render a synthetic walk through textured rooms, as TUM RGB-D sequences")
    p.add_argument("out", type=Path, metavar="OUT", help="folder for the sequences walk_1, walk_2, ...")
    p.add_argument("--sequences", type=int, default=1, help="number of sequences, each in its own house (1)")
    p.add_argument("--frames", type=int, default=400, help="images per sequence (400)")
    p.add_argument("--size", type=size, default=(320, 240), help="size of an image (320x240)")
    p.add_argument("--laps", type=int, default=3, help="laps through the house (3)")
    p.add_argument("--depth", action="store_true", help="write depth images too, in TUM's form")
    p.add_argument("--rooms", type=int, default=4, help="rooms per house, an even number (4)")
    p.add_argument("--seed", type=seed, default=1, help="random seed (1)")
    p.add_argument(
        "--season", type=int, default=1, metavar="N", help="the same houses, repainted, in other light and weather (1)"
    )


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
            start_s=10_000.0 * number + SEASON_S * (arguments.season - 1),
            season=arguments.season,
        )
        folder = arguments.out / f"walk_{number}"
        for _ in bar(write_walk(folder, walk), folder.name, walk.frames):
            pass
        print(f"{folder}: {walk.frames} images, {walk.laps} laps of {walk.rooms} rooms")
