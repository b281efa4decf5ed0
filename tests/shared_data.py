"""Where the data that is not part of the project is: ``../shared`` beside it, or what NETSPEC_SHARED names."""

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("NETSPEC_SHARED", Path(__file__).parents[2] / "shared"))


def shared(*parts: str) -> Path:
    """Return a folder or file of that data, or skip the test where it is absent."""
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{path} is not here (set NETSPEC_SHARED)")
    return path
