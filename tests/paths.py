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


# Nets that differ from another one in their depth or in the size of their last layer alone.
_ALIKE = ("SENet-154", "SE-ResNet-152", "SE-ResNet-101", "SE-ResNeXt-101", "ResNet-152-deploy", "ResNet-101-deploy")
_ALIKE_IN_OURS = ("siamese_128", "siamese_resnet27_512")


def nets_as_found() -> list[Path]:
    """Return the prototxts of the project's nets, and of public nets if they are there, one of each kind."""
    found = sorted(path for path in (ROOT / "prototxt").rglob("*.prototxt") if path.parent.name not in _ALIKE_IN_OURS)
    found += sorted(path for path in (SHARED / "corpus").rglob("*.prototxt") if path.stem not in _ALIKE)
    return [path for path in found if "solver" not in path.name]


def last_parts(path: Path) -> str:
    """Return the id of a test for a file: the name of the file and two folders."""
    return "/".join(path.parts[-3:])


def shared(*parts: str) -> Path:
    """Return a folder or file of that data, or skip the test where it is absent."""
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{path} is not here (set NETSPEC_SHARED)")
    return path
