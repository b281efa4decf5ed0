#!/usr/bin/env python3
"""Make a Python environment, ``.venv`` in this project, once, and install into it: ``python3 tools/install.py``.

``--cpu`` installs PyTorch without NVIDIA's libraries. These variables are read, and pip's own:
VENV   another environment, which may exist already; a PyTorch in it is kept
NEEDS  extras of pyproject.toml; without it, only the dependencies of the programs are installed
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = Path(os.environ.get("VENV") or ROOT / ".venv").absolute()
PROGRAMS = VENV / "bin"
TEMPORARY = VENV / "tmp"  # pip unpacks gigabytes, and the system's folder may be in memory
JETSON = Path("/etc/nv_tegra_release")
NVIDIA = Path("/proc/driver/nvidia")
INDEXES = ("PIP_EXTRA_INDEX_URL", "PIP_INDEX_URL")
PINNED = ("-c", str(ROOT / "constraints.txt"), "torch")
SMALL_ON_ARM = ("torch<2.11",)  # the last versions whose wheel for ARM64 has no libraries of NVIDIA


def program(name: str) -> str:
    """Return the path of a program of the environment."""
    return str(PROGRAMS / name)


def install(cpu: bool = False) -> None:
    """Make the environment complete, unless it is already. Exits with a message if it cannot."""
    needs = os.environ.get("NEEDS", "")
    marks = [VENV / "installed"] + ([VENV / f"installed-{needs}"] if needs else [])
    if not (Path(program("netspec")).exists() and _is_newer(marks[-1], ROOT / "pyproject.toml")):
        if not _runs("-m", "pip", "--version"):
            _make()
        TEMPORARY.mkdir(exist_ok=True)
        if _runs("-c", "import torch"):
            _say(f"Installing into {VENV}, once. The PyTorch in it is kept")
        else:
            _pip(*_torch(cpu))
        _say("Installing everything else")
        _pip("-e", f"{ROOT}[{needs}]" if needs else str(ROOT))
        shutil.rmtree(TEMPORARY)
        for mark in marks:
            mark.touch()
    subprocess.check_call([sys.executable, str(ROOT / "prototxt" / "variants.py")])


def _runs(*words: str) -> bool:
    """Return whether the environment's Python exists and runs something without an error."""
    if not Path(program("python")).exists():
        return False
    return subprocess.call([program("python"), *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) == 0


def _is_newer(mark: Path, other: Path) -> bool:
    return mark.exists() and mark.stat().st_mtime >= other.stat().st_mtime


def _make() -> None:
    if sys.version_info < (3, 10):  # noqa: UP036  this file also runs with older versions, to say this
        version = platform.python_version()
        sys.exit(f"Python {version} is too old; use Python 3.10 or later: PYTHON=python3.12 tools/quickstart")
    subprocess.check_call([sys.executable, "-m", "venv", str(VENV)])


def _torch(cpu: bool) -> tuple[str, ...]:
    """Return what pip installs for PyTorch, after saying how much it takes."""
    linux, arm = sys.platform == "linux", platform.machine() in ("aarch64", "arm64")
    named = any(os.environ.get(name) for name in INDEXES)
    if linux and arm and not cpu and JETSON.exists():
        sys.exit(f"This is a Jetson: install NVIDIA's PyTorch into {VENV} first (docs/robot.md), or give --cpu")
    if linux and arm and not named and (cpu or not NVIDIA.exists()):
        _say(f"Installing into {VENV}, once. This takes minutes and 1.4 GB: PyTorch for the CPU alone")
        return SMALL_ON_ARM
    if linux and cpu and not named:
        sys.exit("--cpu: PyTorch for the CPU alone is in another index; set PIP_EXTRA_INDEX_URL: docs/start.md")
    if linux and not named:
        _say(f"Installing into {VENV}, once. This takes minutes and 5.2 GB, most of it for NVIDIA GPUs.")
        _say("With PyTorch for the CPU alone it takes 1.5 GB: see docs/start.md")
    else:
        _say(f"Installing into {VENV}, once. This takes minutes")
    return PINNED


def _pip(*words: str) -> None:
    """Call pip, which compiles nothing: Python does so at a module's first import, and most are never imported."""
    quiet = [] if sys.stderr.isatty() else ["--quiet"]  # on a terminal pip shows how long a download takes
    command = [program("python"), "-m", "pip", "install", *quiet, "--no-compile", "--disable-pip-version-check", *words]
    folders = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(TEMPORARY))
    status = subprocess.call(command, env={**os.environ, **folders}, stdout=sys.stderr)
    if status:
        sys.exit(status)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    if any(word != "--cpu" for word in sys.argv[1:]):
        sys.exit("usage: install.py [--cpu]")
    install("--cpu" in sys.argv)
