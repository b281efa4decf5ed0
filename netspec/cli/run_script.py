"""``netspec run``, which runs a program written for pycaffe, ``install-caffe`` and ``remove-caffe``."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from netspec.cli.arguments import add_limit, add_plugin
from netspec.files.limits import LIMIT
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.output import VARIABLE
from netspec.terminal.parser import NO_LOG, Commands

NAME = "run"
_WITH_VALUE = ("--plugin", "--write-py3", "--minloglevel", "--limit")


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_run(commands)
    _add_install_caffe(commands)
    _add_remove_caffe(commands)


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


def _add_run(commands: Commands) -> None:
    parser = commands.add_parser(
        NAME,
        help="run a Python script in which `import caffe` imports netspec",
        usage="netspec run [options] (SCRIPT | -m MODULE) [arguments of the script]",
    )
    parser.set_defaults(function=_run, **NO_LOG)
    add_plugin(parser)
    add_limit(parser)
    parser.add_argument("--shadow-caffe", action="store_true", help="use netspec even if a real Caffe is installed")
    parser.add_argument(
        "--python2", action="store_true", help="translate from Python 2, even if the script is valid Python 3"
    )
    parser.add_argument(
        "--write-py3",
        type=Path,
        metavar="F.py",
        help="translate a Python 2 script, write it to this file, and run nothing",
    )
    parser.add_argument("-m", action="store_true", help="run a module, as python -m does")


def _run(arguments: argparse.Namespace) -> None:
    from netspec.compat.scripts.program import Options, run_module, run_script
    from netspec.compat.scripts.sources import write_translation
    from netspec.terminal.process import keep_freed_memory

    keep_freed_memory()  # most scripts train

    if not arguments.program:
        raise WrongUsage("the following arguments are required: SCRIPT, or -m MODULE")
    if arguments.minloglevel is not None:
        os.environ[VARIABLE] = str(arguments.minloglevel)
    if arguments.limit is not None:
        os.environ[LIMIT] = str(arguments.limit)
    options = Options(arguments.shadow_caffe, arguments.python2)
    name, *own = arguments.program
    if arguments.write_py3:
        if arguments.m or arguments.shadow_caffe or own:
            raise WrongUsage(
                "--write-py3 translates a script and runs nothing; leave out -m, --shadow-caffe and its arguments"
            )
        write_translation(name, arguments.write_py3, arguments.python2)
        return
    if arguments.m:
        run_module(name, own, options)
    run_script(name, own, options)


def _add_install_caffe(commands: Commands) -> None:
    parser = commands.add_parser(
        "install-caffe", help="put a package `caffe` and Caffe's commands into this Python environment"
    )
    parser.set_defaults(function=_install_caffe)
    parser.add_argument("--replace", action="store_true", help="if a real Caffe is installed, move it aside")
    parser.add_argument(
        "--build",
        type=Path,
        metavar="FOLDER",
        help="only create FOLDER/tools/caffe and so on, for shell scripts that call build/tools/caffe",
    )


def _install_caffe(arguments: argparse.Namespace) -> None:
    from netspec.compat.scripts.environment import install_caffe, make_build_folder

    if arguments.build:
        refuse(arguments, ("replace",), "is for this Python environment; leave it out with --build")
    written = make_build_folder(arguments.build) if arguments.build else install_caffe(arguments.replace)
    for path in written:
        print(f"{path}: written")
    if arguments.build:
        print(f"Caffe's commands are in {arguments.build}; netspec remove-caffe --build removes them")
    else:
        print("import caffe and Caffe's commands now use netspec; netspec remove-caffe undoes this")


def _add_remove_caffe(commands: Commands) -> None:
    parser = commands.add_parser("remove-caffe", help="undo install-caffe")
    parser.set_defaults(function=_remove_caffe)
    parser.add_argument("--build", type=Path, metavar="FOLDER", help="undo install-caffe --build FOLDER")


def _remove_caffe(arguments: argparse.Namespace) -> None:
    from netspec.compat.scripts.environment import remove_build_folder, remove_caffe

    removed = remove_build_folder(arguments.build) if arguments.build else remove_caffe()
    for path in removed:
        print(f"{path}: removed")
    if not removed:
        print(f"nothing to remove: install-caffe wrote nothing into {arguments.build or 'this Python environment'}")
