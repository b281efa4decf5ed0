"""Where things are: the project, its golden data, and the data that is not part of it.

That last is ``../shared`` beside the project, or what NETSPEC_SHARED names.
"""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "golden"
SHARED = Path(os.environ.get("NETSPEC_SHARED", ROOT.parent / "shared"))


def shared(*parts: str) -> Path:
    """Return a folder or file of that data, or skip the test where it is absent."""
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{path} is not here (set NETSPEC_SHARED)")
    return path
