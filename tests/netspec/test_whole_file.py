"""Files that appear whole, and whether one could be written."""

import os
from pathlib import Path

import pytest

from netspec.errors import SpecError
from netspec.whole_file import whole_file, why_unwritable


def test_why_no_file_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert why_unwritable(tmp_path / "new") == ""
    assert why_unwritable(tmp_path / "file") == ""
    assert why_unwritable(tmp_path) == "Is a directory"
    assert why_unwritable(tmp_path / "gone" / "new") == "No such file or directory"
    assert why_unwritable(tmp_path / "file" / "new") == "Not a directory"
    assert why_unwritable(tmp_path / ("n" * 300)) == "File name too long"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


def test_a_folder_without_leave_to_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)  # root may write everywhere
    assert why_unwritable(tmp_path / "new") == "Permission denied"
    (tmp_path / "old").touch()
    assert why_unwritable(tmp_path / "old") == ""


def test_a_failed_write_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def write() -> None:
        with whole_file(path) as unfinished:
            unfinished.write_text("new")
            raise OSError("disk full")

    with pytest.raises(SpecError, match="cannot be written: disk full"):
        write()
    assert [path.read_text(), *tmp_path.iterdir()] == ["old", path]
