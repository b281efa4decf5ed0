"""A separate environment for libraries that conflict with netspec's, or that netspec does not need."""

from __future__ import annotations

import subprocess
import sys
import venv

from benchmarks.case import ROOT
from netspec.errors import SpecError

FOLDER = ROOT / ".venv-bench"
PACKAGES = (
    "opencv-python-headless==4.14.0.94",  # the last OpenCV 4
    "onnxruntime>=1.20",
    "openvino>=2024.6",
)


def python() -> str:
    """Return the path of the environment's Python. The first call installs it. Raises SpecError if that fails."""
    program, done = FOLDER / "bin" / "python", FOLDER / "installed"
    wanted = "\n".join(PACKAGES)
    if not done.is_file() or done.read_text() != wanted:
        print(f"Installing the libraries to compare with into {FOLDER} ...", file=sys.stderr)
        venv.create(FOLDER, with_pip=True)
        words = [str(program), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *PACKAGES]
        finished = subprocess.run(words, capture_output=True, text=True, check=False)
        if finished.returncode:
            last = (finished.stderr.strip().splitlines() or ["pip failed"])[-1]
            raise SpecError(f"{FOLDER}: cannot install the libraries to compare with: {last}")
        done.write_text(wanted)
    return str(program)
