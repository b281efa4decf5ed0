"""``netspec run``: a program that was written for pycaffe."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence

from netspec.terminal.commands import VARIABLE, WrongUsage, refuse

NAME, USAGE = "run", "netspec run [options] (SCRIPT | -m MODULE) [arguments of the script]"
_WITH_VALUE = ("--plugin", "--write-py3", "--minloglevel", "--limit")


TABLE = """
run silent built                   run a Python script; in it `import caffe` finds netspec
  --shadow-caffe                   use netspec also where a real Caffe is installed
  --python2                        translate from Python 2, also what runs as Python 3
  --write-py3 F.py                 only write a script of Python 2 as Python 3
  -m                               run a module, as python -m does
install-caffe                      put a package `caffe` and Caffe's commands into this Python environment
  --replace                        move a real Caffe that is in the way aside
  --build FOLDER                   only make FOLDER/tools/caffe and so on, for scripts
remove-caffe                       undo install-caffe
  --build FOLDER                   undo install-caffe --build FOLDER
"""


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return what is for ``netspec run``, and the script or module with its own arguments, which nobody else reads."""
    position = 1
    while position < len(words) and words[position].startswith("-"):
        name = "--" + words[position].lstrip("-")
        position += 1
        if words[position - 1] == "-m":
            break
        position += name in _WITH_VALUE
    return list(words[:position]), list(words[position:])


def _run(arguments: argparse.Namespace) -> None:
    from netspec.compat.scripts.program import Options, run_module, run_script
    from netspec.compat.scripts.sources import write_translation
    from netspec.process.heap import keep_freed_memory

    keep_freed_memory()  # most scripts train

    if not arguments.program:
        raise WrongUsage("the following arguments are required: SCRIPT, or -m MODULE")
    if arguments.minloglevel is not None:
        os.environ[VARIABLE] = str(arguments.minloglevel)
    options = Options(arguments.shadow_caffe, arguments.python2)
    name, *own = arguments.program
    if arguments.write_py3:
        if arguments.m or arguments.shadow_caffe or own:
            raise WrongUsage("--write-py3 takes a script, and nothing runs")
        write_translation(name, arguments.write_py3, arguments.python2)
        return
    if arguments.m:
        run_module(name, own, options)
    run_script(name, own, options)


def _install_caffe(arguments: argparse.Namespace) -> None:
    from netspec.compat.scripts.environment import install_caffe, make_build_folder

    if arguments.build:
        refuse(arguments, ("replace",), "is for this Python environment, not for --build")
    written = make_build_folder(arguments.build) if arguments.build else install_caffe(arguments.replace)
    for path in written:
        print(f"{path}: written")
    if arguments.build:
        print(f"scripts find Caffe's commands in {arguments.build}; netspec remove-caffe --build undoes this")
    else:
        print("import caffe and Caffe's commands are netspec's now; netspec remove-caffe undoes this")


def _remove_caffe(arguments: argparse.Namespace) -> None:
    from netspec.compat.scripts.environment import remove_build_folder, remove_caffe

    removed = remove_build_folder(arguments.build) if arguments.build else remove_caffe()
    for path in removed:
        print(f"{path}: removed")
    if not removed:
        print(f"nothing to remove: install-caffe wrote nothing into {arguments.build or 'this Python environment'}")
