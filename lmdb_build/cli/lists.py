"""``lmdb-build sheet`` and ``lmdb-build join``."""

from __future__ import annotations

import argparse
from pathlib import Path

from lmdb_build.pairs.contact_sheet import write_contact_sheet
from lmdb_build.pairs.list_file import join_lists, root_of
from netspec.terminal.commands import Commands, seed


def add_to(commands: Commands) -> None:
    """Add the commands."""
    p = commands.add("sheet", _sheet, "draw sample pairs of a list as a picture")
    p.add_argument("list", type=Path, metavar="LIST", help="a list of pairs")
    p.add_argument("out", type=Path, metavar="PICTURE", help="the picture to write, such as sheet.png")
    p.add_argument("--root", type=Path, help="folder of the images (default: as in the list's header)")
    p.add_argument("--rows", type=int, default=6, help="pairs of each label (6)")
    p.add_argument("--seed", type=seed, default=1, help="seed of the random choice (1)")

    p = commands.add("join", _join, "shuffle several lists into one")
    p.add_argument("out", type=Path, metavar="OUT", help="the list to write")
    p.add_argument("lists", type=Path, nargs="+", metavar="LIST", help="lists of pairs")
    p.add_argument("--root", type=Path, help="folder that the names are relative to (the lists' roots' parent)")
    p.add_argument("--seed", type=seed, default=1, help="seed of the random order (1)")


def _sheet(arguments: argparse.Namespace) -> None:
    root = arguments.root or root_of(arguments.list)
    write_contact_sheet(arguments.list, root, arguments.out, arguments.rows, arguments.seed)
    print(arguments.out)


def _join(arguments: argparse.Namespace) -> None:
    number, root = join_lists(arguments.lists, arguments.out, arguments.seed, arguments.root)
    print(f"{arguments.out}: {number} pairs, images below {root}")
