"""Writing files and folders completely or not at all, lock files, and a check whether a path is writable.

An unfinished file has a hidden name next to its path, ``.NAME.XXXXXXXX.unfinished``, and is locked. If its process is
killed, the next process that writes into the same folder removes it.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from netspec.errors import Code, SpecError, Where

NO_NUL = "a file name cannot contain a NUL character"
_LEFTOVER = re.compile(r"\..+\.[0-9a-f]{8}\.unfinished")
_MARK = re.compile(rb"a lock of netspec, held by process (\d+)\n")
_AS_IT_IS = os.O_NOFOLLOW | os.O_NONBLOCK  # no links, no waiting for pipes
_swept: set[Path] = set()


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``. At the end of the block it is synced to disk and renamed to ``path``.

    Symbolic links are kept, and pipes and devices are written to. The new file gets the mode and owner of the old one.
    If the block fails, the temporary file is removed and the old file is kept. Raises SpecError if the file cannot be
    written.
    """
    if "\0" in str(path):
        raise _unwritable(NO_NUL, path)
    real = Path(os.path.realpath(path))
    try:
        if real.exists() and not real.is_file() and not real.is_dir():  # a pipe or device
            with TemporaryDirectory() as folder:
                yield Path(folder, real.name)
                with Path(folder, real.name).open("rb") as source, real.open("wb") as target:
                    shutil.copyfileobj(source, target)
            return
        before = real.stat() if real.is_file() else None
        with _unfinished(real) as (unfinished, held):
            if before is not None:
                os.chmod(unfinished, 0o600)
            yield unfinished
            if before is not None:
                _pass_on(before, held)
            os.fsync(held)
    except OSError as fault:
        reason = os.strerror(fault.errno) if fault.errno else fault  # h5py's own message is a paragraph
        raise _unwritable(reason, path) from None


def write_whole(path: str | Path, content: str | bytes, errors: str = "strict") -> None:
    """Write bytes, or text as UTF-8, completely or not at all; see :func:`whole_file`.

    ``errors`` is as in :func:`open`, for file names that are not UTF-8.
    """
    with whole_file(path) as unfinished:
        unfinished.write_bytes(content.encode("utf-8", errors) if isinstance(content, str) else content)


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """Yield a new folder next to ``path``. At the end of the block it is synced to disk and renamed to ``path``.

    If the block fails, it is removed. Raises OSError if it cannot be created or renamed.
    """
    with _unfinished(Path(os.path.realpath(path)), folder=True) as (unfinished, _):
        yield unfinished
        for file in [*filter(Path.is_file, unfinished.iterdir()), unfinished]:
            _sync(file)


@contextmanager
def only_one(path: str | Path, advice: str) -> Iterator[None]:
    """Hold the lock file ``path`` within the block. The lock also ends if the process is killed.

    The lock file of a killed process is reused, and a file with other contents is not changed. If the file system has
    no locks, nothing is locked. Raises SpecError, with ``advice``, if another process holds the lock, or if the file
    cannot be created.
    """
    path = Path(path)
    fault = SpecError("is not a lock file of netspec; move it away", Where(str(path)))
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise fault
    try:
        held, locked = _open_locked(path, os.O_CREAT | os.O_RDWR)
    except OSError as error:
        raise _unwritable(error.strerror, path) from None
    try:
        text = os.read(held, 100)
        owner = _MARK.fullmatch(text)
        if text and not owner:
            raise fault
        if not locked:
            of = f" (process {int(owner[1])})" if owner else ""
            raise SpecError(f"is locked by another process{of}; {advice}", Where(str(path)))
        os.ftruncate(held, 0)
        os.lseek(held, 0, os.SEEK_SET)
        os.write(held, f"a lock of netspec, held by process {os.getpid()}\n".encode())
        try:
            yield
        finally:
            _remove(path)  # while it is locked, so that it is not the next owner's
    finally:
        os.close(held)


def why_unwritable(path: str | Path) -> str:
    """Return the operating system's reason why no file can be written at ``path``, or "".

    Only the path and its permissions are checked. A full disk, for example, is not detected.
    """
    path, folder = Path(path), Path(path).parent
    if "\0" in str(path):
        return NO_NUL
    try:
        if not stat.S_ISDIR(folder.stat().st_mode):
            return os.strerror(errno.ENOTDIR)
        kind = path.stat().st_mode if path.exists() else stat.S_IFREG
    except OSError as fault:
        return fault.strerror or str(fault)
    if stat.S_ISDIR(kind):
        return os.strerror(errno.EISDIR)
    renamed_over = not stat.S_ISREG(kind) or os.access(folder, os.W_OK | os.X_OK)  # a pipe or a device is not
    return "" if renamed_over and (not path.exists() or os.access(path, os.W_OK)) else _denied(folder)


def why_no_folder(path: str | Path) -> str:
    """Return why no files can be written into the folder ``path``, which is made where it is missing, or ""."""
    path = Path(os.path.abspath(path))
    try:
        while not path.exists():
            path = path.parent
    except (OSError, ValueError) as fault:
        return getattr(fault, "strerror", None) or str(fault)
    if not path.is_dir():
        return os.strerror(errno.ENOTDIR)
    return "" if os.access(path, os.W_OK | os.X_OK) else _denied(path)


def _denied(folder: Path) -> str:
    return os.strerror(errno.EROFS if os.statvfs(folder).f_flag & os.ST_RDONLY else errno.EACCES)


@contextmanager
def _unfinished(path: Path, folder: bool = False) -> Iterator[tuple[Path, int]]:
    """Yield a new file or folder, locked, and its descriptor; at the end rename it, or remove it if the block fails."""
    _sweep(path.parent)
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}.unfinished")
    try:
        if folder:
            unfinished.mkdir()
        held, _ = _open_locked(unfinished, os.O_RDONLY if folder else os.O_CREAT | os.O_EXCL | os.O_RDWR)
        try:
            yield unfinished, held
            unfinished.replace(path)  # while it is locked, so that no sweep removes it
        finally:
            os.close(held)
        _sync(path.parent)
    finally:
        _remove(unfinished)


def _pass_on(before: os.stat_result, held: int) -> None:
    """Give a file the owner and mode of the file that it replaces. If the group differs, it gets no permissions."""
    mode = stat.S_IMODE(before.st_mode)
    with suppress(OSError):
        os.fchown(held, before.st_uid, -1)
    with suppress(OSError):
        os.fchown(held, -1, before.st_gid)
    os.fchmod(held, mode if os.fstat(held).st_gid == before.st_gid else mode & ~0o070)


def _open_locked(path: Path, flags: int) -> tuple[int, bool]:
    """Open a file and lock it; return its descriptor, and False if another process holds the lock.

    If another process removes the file before it is locked, it is opened again.
    """
    while True:
        held = os.open(path, flags | _AS_IT_IS, 0o666)
        locked = _lock(held) is not False
        with suppress(FileNotFoundError):
            if not locked or os.path.samestat(os.fstat(held), path.stat()):
                return held, locked
        os.close(held)


def _lock(descriptor: int) -> bool | None:
    """Lock an open file. Return False if another process holds the lock, and None if locks are not supported."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _sweep(folder: Path) -> None:
    """Remove the unfinished files of killed processes, which nobody locks, from a folder, once per process."""
    if folder in _swept:
        return
    _swept.add(folder)
    with suppress(OSError):
        for path in [folder / name for name in os.listdir(folder) if _LEFTOVER.fullmatch(name)]:
            with suppress(OSError):
                held = os.open(path, os.O_RDONLY | _AS_IT_IS)
                kind = os.fstat(held).st_mode
                if (stat.S_ISREG(kind) or stat.S_ISDIR(kind)) and _lock(held):
                    _remove(path)
                os.close(held)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _sync(path: Path) -> None:
    """Sync a file or a folder to disk: a power failure could undo a rename. Not all systems can do this for folders."""
    with suppress(OSError) if path.is_dir() else nullcontext():
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _unwritable(reason: object, path: str | Path) -> Exception:
    return SpecError(f"cannot be written: {reason}", Where(str(path)), Code.UNWRITABLE, (reason,))
