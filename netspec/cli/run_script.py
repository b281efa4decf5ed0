"""``netspec run``, which runs a program written for pycaffe, ``install-caffe`` and ``remove-caffe``."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from netspec.cli.arguments import add_limit, add_plugin
from netspec.files.limits import LIMIT
from netspec.terminal.commands import WrongUsage
from netspec.terminal.output import VARIABLE
from netspec.terminal.parser import Commands

NAME = "run"
_WITH_VALUE = ("--plugin", "--minloglevel", "--limit")


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    parser = commands.add_parser(
        NAME,
        _run,
        help="run a Python 3 script in which `import caffe` imports netspec",
        usage="netspec run [options] (SCRIPT | -m MODULE) [arguments of the script]",
    )
    add_plugin(parser)
    add_limit(parser)
    parser.add_argument("-m", action="store_true", help="run a module, as python -m does")
    parser = commands.add_parser(
        "install-caffe",
        _install_caffe,
        help="put a package `caffe` and Caffe's commands into this Python environment",
    )
    parser.add_argument(
        "--build",
        type=Path,
        metavar="FOLDER",
        help="only create FOLDER/tools/caffe and so on, for shell scripts that call build/tools/caffe",
    )
    parser = commands.add_parser("remove-caffe", _remove_caffe, help="undo install-caffe")
    parser.add_argument("--build", type=Path, metavar="FOLDER", help="undo install-caffe --build FOLDER")


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split the words into the options of ``netspec run``, and the script or module with its own arguments."""
    position = 1
    while position < len(words) and words[position].startswith("-"):
        name = "--" + words[position].lstrip("-")
        position += 1
        if words[position - 1] == "-m":
            break
        position += name in _WITH_VALUE
    return list(words[:position]), list(words[position:])


def _run(arguments: argparse.Namespace) -> None:
    from netspec.compat.scripts.program import run_module, run_script
    from netspec.terminal.process import keep_freed_memory

    keep_freed_memory()  # most scripts train

    if not arguments.program:
        raise WrongUsage("the following arguments are required: SCRIPT, or -m MODULE")
    if arguments.minloglevel is not None:
        os.environ[VARIABLE] = str(arguments.minloglevel)
    if arguments.limit is not None:
        os.environ[LIMIT] = str(arguments.limit)
    name, *own = arguments.program
    run = run_module if arguments.m else run_script
    run(name, own)


def _install_caffe(arguments: argparse.Namespace) -> None:
    from netspec.compat.scripts.environment import install_caffe, make_build_folder

    written = make_build_folder(arguments.build) if arguments.build else install_caffe()
    for path in written:
        print(f"{path}: written")
    if arguments.build:
        print(f"Caffe's commands are in {arguments.build}; netspec remove-caffe --build removes them")
    else:
        print("import caffe and Caffe's commands now use netspec; netspec remove-caffe undoes this")


def _remove_caffe(arguments: argparse.Namespace) -> None:
    from netspec.compat.scripts.environment import remove_build_folder, remove_caffe

    removed = remove_build_folder(arguments.build) if arguments.build else remove_caffe()
    for path in removed:
        print(f"{path}: removed")
    if not removed:
        print(f"nothing to remove: install-caffe wrote nothing into {arguments.build or 'this Python environment'}")
