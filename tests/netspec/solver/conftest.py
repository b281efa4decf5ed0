"""A folder to train in, as the golden files want it: ``pairs/`` beside a folder of the case's own."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parents[2] / "golden"


@pytest.fixture
def work_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Return a function that copies a golden folder into the working directory, under a name of choice."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")

    def copy(source: str, name: str = "") -> Path:
        return Path(shutil.copytree(GOLDEN / source, name or Path(source).name))

    return copy
