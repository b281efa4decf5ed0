"""Paths relative to others, on one drive and on two, which only Windows has."""

import os
from pathlib import Path

import pytest

from netspec.errors import SpecError
from netspec.files.drives import common_folder, relative


def test_paths_on_one_drive(tmp_path: Path) -> None:
    assert relative(tmp_path / "a" / "b", tmp_path / "c") == "../a/b"
    assert common_folder([tmp_path / "a" / "b", tmp_path / "a" / "c"]) == tmp_path / "a"


def test_paths_on_two_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> str:
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", refuse)
    monkeypatch.setattr(os.path, "commonpath", refuse)
    assert relative("/d/images", "/c/lists") == "/d/images"
    with pytest.raises(SpecError, match=r"^/c/a, /d/b: are on different drives, so they have no common folder"):
        common_folder([Path("/c/a"), Path("/d/b")])
