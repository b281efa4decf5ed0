"""Files that appear whole, locks, and whether a file could be written."""

import errno
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


def test_why_a_file_in_a_read_only_folder_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_where_files_have_no_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")  # as on some network file systems

    monkeypatch.setattr(package.fcntl, "flock", refuse)
    with package.whole_file(tmp_path / "file") as unfinished:
        unfinished.write_text("new")
    with package.whole_folder(tmp_path / "folder") as unfinished:
        (unfinished / "file").touch()
    with package.only_one(tmp_path / "lock", ""):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


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
        message = rf"x\.lock: is locked by another process \(process {process.pid}\); choose another name"
        with pytest.raises(ValueError, match=message), package.only_one(tmp_path / "x.lock", "choose another name"):
            pass
        process.send_signal(signal.SIGKILL)
    with package.only_one(tmp_path / "x.lock", "choose another name"):
        assert (tmp_path / "x.lock").read_text() == f"a lock of netspec, held by process {os.getpid()}\n"
    assert not list(tmp_path.iterdir())


def test_a_lock_leaves_what_others_made_as_it_was(tmp_path: Path) -> None:
    theirs, target, link = tmp_path / "poetry", tmp_path / "target", tmp_path / "link"
    theirs.write_text("[[package]]\n")
    link.symlink_to(target)
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "folder").mkdir()
    for name in ("poetry", "link", "fifo", "folder"):
        with (
            pytest.raises(ValueError, match=f"{name}: is not a lock file of netspec"),
            package.only_one(tmp_path / name, ""),
        ):
            pass
    assert theirs.read_text() == "[[package]]\n"
    assert link.is_symlink()
    assert not target.exists()


def test_a_lock_that_a_killed_run_left_is_taken(tmp_path: Path) -> None:
    with start("held = only_one('x', ''); held.__enter__()", tmp_path) as process:
        process.kill()
    assert (tmp_path / "x").exists()
    with package.only_one(tmp_path / "x", ""):
        assert str(os.getpid()) in (tmp_path / "x").read_text()
    assert not (tmp_path / "x").exists()


def test_mode_and_owner_of_what_is_replaced_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, link = tmp_path / "file", tmp_path / "link"
    path.touch()
    link.symlink_to(path)
    for mode in (0o600, 0o755, 0o664):
        path.chmod(mode)
        with package.whole_file(link) as unfinished:
            assert unfinished.stat().st_mode & 0o777 & ~mode == 0  # nobody else may read it meanwhile either
            unfinished.write_text("new")
        assert path.stat().st_mode & 0o7777 == mode
    if os.geteuid() == 0:
        os.chown(path, 1234, 4321)
        with package.whole_file(path) as unfinished:
            unfinished.write_text("new")
        assert (path.stat().st_uid, path.stat().st_gid) == (1234, 4321)

    def refused(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "fchown", refused)
    path.chmod(0o660)
    os.chown(path, -1, 4322 if os.geteuid() == 0 else -1)
    with package.whole_file(path) as unfinished:
        unfinished.write_text("new")
    assert os.geteuid() or path.stat().st_mode & 0o777 == 0o600  # the group is another one
