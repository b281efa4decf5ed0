"""Files that appear whole, locks, and whether a file could be written."""

import errno
import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from netspec.files import whole_file as package
from paths import ROOT


def test_why_no_file_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    why = package.why_unwritable
    assert why(tmp_path / "new") == ""
    assert why(tmp_path / "file") == ""
    assert why(tmp_path) == "Is a directory"
    assert why(tmp_path / "gone" / "new") == "No such file or directory"
    assert why(tmp_path / "file" / "new") == "Not a directory"
    assert why(tmp_path / ("n" * 300)) == "File name too long"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


def test_a_folder_without_leave_to_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)  # root may write everywhere
    assert package.why_unwritable(tmp_path / "new") == "Permission denied"
    (tmp_path / "old").touch()
    assert package.why_unwritable(tmp_path / "old") == "Permission denied"  # to replace it writes into the folder
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) == tmp_path)
    assert package.why_unwritable(tmp_path / "old") == "Permission denied"


def test_a_failed_write_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def write() -> None:
        with package.whole_file(path) as unfinished:
            unfinished.write_text("new")
            raise OSError("disk full")

    with pytest.raises(ValueError, match="file: cannot be written: disk full"):
        write()
    assert [path.read_text(), *tmp_path.iterdir()] == ["old", path]


def test_the_file_and_its_folder_are_on_disk_before_the_block_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[tuple[bool, list[str]]] = []

    def sync(descriptor: int) -> None:
        is_folder = os.path.samestat(os.fstat(descriptor), tmp_path.stat())
        synced.append((is_folder, [path.name for path in tmp_path.iterdir()]))

    monkeypatch.setattr(os, "fsync", sync)
    with package.whole_file(tmp_path / "file") as unfinished:
        unfinished.write_text("new")
    assert synced == [(False, [unfinished.name]), (True, ["file"])]


def test_a_folder_that_cannot_be_synced_is_no_fault_and_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(errno.EACCES, "Access is denied")  # as on Windows

    monkeypatch.setattr(package, "_sync", refuse)
    monkeypatch.setattr(logging.getLogger(package.__name__), "propagate", True)
    monkeypatch.setattr(logging.getLogger(package.__name__.partition(".")[0]), "propagate", True)
    package._say_not_synced.cache_clear()
    for text in ("new", "newer"):
        with package.whole_file(tmp_path / "file") as unfinished:
            unfinished.write_text(text)
    assert (tmp_path / "file").read_text() == "newer"
    (record,) = caplog.records
    assert record.getMessage().startswith("folders cannot be brought to disk here (Permission denied)")


def test_where_files_have_no_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(package, "fcntl", None)
    with package.whole_file(tmp_path / "file") as unfinished:
        unfinished.write_text("new")
    with package.whole_folder(tmp_path / "folder") as unfinished:
        (unfinished / "file").touch()
    with package.only_one(tmp_path / "lock", ""):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_why_unwritable_where_file_systems_tell_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "statvfs")  # as on Windows
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert package.why_unwritable(tmp_path / "file") == os.strerror(errno.EACCES)


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there" / "file")
    with package.whole_file(tmp_path / "link") as unfinished:
        unfinished.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "there" / "file").read_text() == "new"


def test_a_pipe_gets_the_bytes_and_stays_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append((tmp_path / "pipe").read_text()))
    reader.start()
    with package.whole_file(tmp_path / "pipe") as unfinished:
        unfinished.write_text("new")
    reader.join()
    assert read == ["new"]
    assert (tmp_path / "pipe").is_fifo()


# What killed runs leave


def start(code: str, folder: Path) -> subprocess.Popen[str]:
    """Run code until it has printed a line."""
    command = [sys.executable, "-c", f"from {package.__name__} import *\n{code}\nprint(flush=True); input()"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, cwd=folder, stdin=pipe, stdout=pipe, text=True, env=environment)
    assert process.stdout is not None
    process.stdout.readline()
    return process


HALF = """
held = whole_folder("folder"), whole_file("file")
held[0].__enter__(), held[1].__enter__().write_text("half")
"""


def test_what_a_killed_run_left_is_swept_by_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".mine.unfinished").touch()
    with start(HALF, tmp_path) as process:
        monkeypatch.setattr(package, "_swept", set())
        with package.whole_file(tmp_path / "other") as unfinished:
            unfinished.touch()
        assert len(list(tmp_path.glob(".*.unfinished"))) == 3, "somebody is still writing these"
        process.send_signal(signal.SIGKILL)
    monkeypatch.setattr(package, "_swept", set())
    with package.whole_file(tmp_path / "other") as unfinished:
        unfinished.touch()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".mine.unfinished", "other"]


def test_a_lock_dies_with_its_process(tmp_path: Path) -> None:
    with start('held = only_one("x.lock", ""); held.__enter__()', tmp_path) as process:
        message = rf"x\.lock: is held by another run \(process {process.pid}\); choose another name"
        with pytest.raises(ValueError, match=message), package.only_one(tmp_path / "x.lock", "choose another name"):
            pass
        process.send_signal(signal.SIGKILL)
    with package.only_one(tmp_path / "x.lock", "choose another name"):
        assert (tmp_path / "x.lock").read_text() == f"{os.getpid()}\n"
    assert not list(tmp_path.iterdir())
