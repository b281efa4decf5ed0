"""Paths: the project, its golden data, and the data that is not part of it.

The latter is in ``../shared`` next to the project, or in the folder that NETSPEC_SHARED names.
"""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "golden"
PYTHON_LAYERS = ROOT / "tests" / "python_layers.py"  # a module of them
SHARED = Path(os.environ.get("NETSPEC_SHARED", ROOT.parent / "shared"))


def nets_as_found() -> list[Path]:
    """Return the prototxts of the project's nets, and of public nets if they are there; larger ones repeat blocks."""
    found = [*(ROOT / "prototxt").rglob("*.prototxt"), *(SHARED / "corpus").rglob("*.prototxt")]
    return sorted(path for path in found if "solver" not in path.name and path.stat().st_size < 20_000)


def last_parts(path: Path) -> str:
    """Return the id of a test for a file: the name of the file and two folders."""
    return "/".join(path.parts[-3:])


def shared(*parts: str) -> Path:
    """Return a folder or file of that data, or skip the test where it is absent."""
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{path} is not here (set NETSPEC_SHARED)")
    return path
