"""A separate environment for OpenCV 4, which conflicts with netspec's."""

from __future__ import annotations

import subprocess
import sys
import venv

from benchmarks.case import ROOT
from netspec.errors import SpecError

FOLDER = ROOT / ".venv-bench"
PACKAGE = "opencv-python-headless==4.14.0.94"  # the last OpenCV 4


def python() -> str:
    """Return the path of the environment's Python. The first call installs it. Raises SpecError if that fails."""
    program, done = FOLDER / "bin" / "python", FOLDER / "installed"
    if not done.is_file() or done.read_text() != PACKAGE:
        print(f"Installing OpenCV 4 into {FOLDER} ...", file=sys.stderr)
        venv.create(FOLDER, with_pip=True)
        words = [str(program), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", PACKAGE]
        finished = subprocess.run(words, capture_output=True, text=True, check=False)
        if finished.returncode:
            last = (finished.stderr.strip().splitlines() or ["pip failed"])[-1]
            raise SpecError(f"{FOLDER}: cannot install OpenCV 4: {last}")
        done.write_text(PACKAGE)
    return str(program)
