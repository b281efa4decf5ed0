"""Used by each script in this folder: runs a command of the packages in this project."""

import os
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"  # made by tools/install.py
PYTHON = VENV / "bin" / "python"
REQUIRED = ("torch", "google.protobuf", "lmdb", "cv2")  # commands import some of these late, or in another process


def run(module: str, *words: str) -> int:
    """Call a module's ``main`` with ``words`` and the command-line arguments; return its exit status.

    If this Python lacks a required package, the script restarts with the Python of ``.venv``. If there is none, it
    prints the command that installs the packages.
    """
    sys.path[0] = str(ROOT)  # in place of this folder
    typed = sys.argv
    try:
        sys.argv = [typed[0], *words, *typed[1:]]
        for name in REQUIRED:
            if find_spec(name) is None:
                raise ModuleNotFoundError(f"No module named '{name}'", name=name)
        return import_module("netspec.terminal.main").program(module)
    except ModuleNotFoundError as fault:
        if PYTHON.is_file() and Path(sys.prefix).resolve() != VENV.resolve():
            os.execv(PYTHON, [str(PYTHON), *typed])
        needed = f"to install the required packages: {sys.executable} {ROOT / 'tools' / 'install.py'}"
        print(f"{sys.argv[0]}: {fault.msg} for {sys.executable}; {needed}", file=sys.stderr)
        return 1
