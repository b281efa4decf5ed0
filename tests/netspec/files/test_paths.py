"""Paths relative to others, on one drive and on two, which only Windows has."""

import os
from pathlib import Path

import pytest

from netspec.files.paths import relative


def test_a_path_on_one_drive(tmp_path: Path) -> None:
    assert relative(tmp_path / "a" / "b", tmp_path / "c") == "../a/b"


def test_a_path_on_another_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> str:
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", refuse)
    assert relative("/d/images", "/c/lists") == "/d/images"
