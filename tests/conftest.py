"""What all tests share: where the golden files are, and one thread a process so that runs in parallel stay quick."""

import os
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def shared(*parts: str) -> Path:
    """Return a folder of the data that is not part of the project, or skip the test where it is absent."""
    root = Path(os.environ.get("NETSPEC_SHARED", Path(__file__).parents[2] / "shared"))
    path = root.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{path} is not here (set NETSPEC_SHARED)")
    return path
