"""What each door of this folder does: it runs a command of the packages beside it."""

import os
import sys
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"  # tools/setup.sh makes it


def run(module: str, *words: str) -> int:
    """Call a module's ``main`` with ``words`` and those of the command line; return its exit status.

    Where this Python lacks a package that is needed, the Python of ``.venv`` starts anew; without one, a line on stderr
    says what to run.
    """
    sys.path[0] = str(ROOT)  # in place of this folder
    try:
        return import_module(module).main([*words, *sys.argv[1:]])
    except ModuleNotFoundError as fault:
        python = VENV / "bin" / "python"
        if python.is_file() and Path(sys.prefix).resolve() != VENV.resolve():
            os.execv(python, [str(python), *sys.argv])
        needed = f"to install what is needed: bash {ROOT / 'tools' / 'setup.sh'}"
        print(f"{sys.argv[0]}: {fault.msg} for {sys.executable}; {needed}", file=sys.stderr)
        return 1
