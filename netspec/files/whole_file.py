"""Writing files and folders completely or not at all, lock files, and a check whether a path is writable.

An unfinished file has a hidden name next to its path, ``.NAME.XXXXXXXX.unfinished``, and is locked. If its process is
killed, the next process that writes into the same folder removes it. Windows can neither rename an open file nor open a
folder: there, a file next to it, ``.NAME.XXXXXXXX.lock``, is locked.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from netspec.errors import Code, SpecError, Where

try:
    import fcntl
except ImportError:
    fcntl: Any = None
    import msvcrt

NO_NUL = "a file name cannot contain a NUL character"
_LEFTOVER = re.compile(r"\..+\.[0-9a-f]{8}\.unfinished")
_MARK = re.compile(rb"a lock of netspec, held by process (\d+)\n")
# No links, no waiting for pipes, no conversion of line ends.
_AS_IT_IS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
_FAR = 0x7FFFFFFF  # Windows: a locked byte cannot be read, so one behind every content is locked
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
        if real.exists() and not real.is_file() and not real.is_dir():
            with _copied_to(real) as unfinished:
                yield unfinished
            return
        before = real.stat() if real.is_file() else None
        with _temporary(real) as unfinished:
            with _created(unfinished, 0o666 if before is None else 0o600) as held:
                yield unfinished
                if before is not None and hasattr(os, "fchown"):  # Windows has none
                    _pass_on(before, held)
                os.fsync(held)
                if fcntl is not None:
                    unfinished.replace(real)  # while it is locked, so that no sweep removes it
            if fcntl is None:
                unfinished.replace(real)
            sync_folder(real.parent)
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
    real = Path(os.path.realpath(path))
    with _temporary(real) as unfinished:
        unfinished.mkdir()
        held = None if fcntl is None else os.open(unfinished, os.O_RDONLY)
        try:
            if held is not None:
                _lock(held)
            yield unfinished
            for file in unfinished.iterdir():
                if file.is_file():
                    _sync(file)
            sync_folder(unfinished)
            unfinished.rename(real)
            sync_folder(real.parent)
        finally:
            if held is not None:
                os.close(held)


@contextmanager
def only_one(path: str | Path, advice: str) -> Iterator[None]:
    """Hold the lock file ``path`` within the block. The lock also ends if the process is killed.

    The lock file of a killed process is reused; any other file is not changed. If the file system has no locks, nothing
    is locked. Raises SpecError, with ``advice``, if another process holds the lock, or if the file
    cannot be created.
    """
    path = Path(path)
    ours = False
    mark = f"a lock of netspec, held by process {os.getpid()}\n".encode()
    try:
        try:
            held, locked = _open_locked(path, os.O_CREAT | os.O_EXCL | os.O_RDWR)
            os.write(held, mark)
        except FileExistsError:
            if path.is_symlink() or not path.is_file():
                raise _fault("is not a lock file of netspec; move it away", path) from None
            held, locked = _open_locked(path, os.O_RDWR)
    except OSError as fault:
        raise _unwritable(fault.strerror, path) from None
    try:
        os.lseek(held, 0, os.SEEK_SET)
        owner = _MARK.fullmatch(os.read(held, 100))
        if not locked:
            of = f" (process {int(owner[1])})" if owner else ""
            raise _fault(f"is locked by another process{of}; {advice}", path)
        if not owner:
            raise _fault("is not a lock file of netspec; move it away", path)
        os.ftruncate(held, 0)
        os.lseek(held, 0, os.SEEK_SET)
        os.write(held, mark)
        ours = True
        try:
            yield
        finally:
            if fcntl is not None:
                _remove(path)  # while it is locked, so that it is not the next owner's
    finally:
        os.close(held)
        if ours and fcntl is None:
            _remove(path)  # Windows refuses this if the next owner has opened it


def sync_folder(folder: Path) -> None:
    """Sync a folder to disk, since a power failure could otherwise undo a rename. Windows has no such call.

    If the file system cannot do this, a warning is logged once.
    """
    if fcntl is None:
        return
    try:
        _sync(folder)
    except OSError as fault:
        _warn_not_synced(os.strerror(fault.errno) if fault.errno else str(fault))


def why_unwritable(path: str | Path) -> str:
    """Return the operating system's reason why no file can be written at ``path``, or "".

    Only the path and its permissions are checked. A full disk, for example, is not detected.
    """
    path = Path(path)
    folder = path.parent
    if "\0" in str(path):
        return NO_NUL
    try:
        if not folder.is_dir():
            folder.stat()
            return os.strerror(errno.ENOTDIR)
        with suppress(FileNotFoundError):
            path.stat()
    except OSError as fault:
        return fault.strerror or str(fault)
    if path.is_dir():
        return os.strerror(errno.EISDIR)
    renamed_over = not path.exists() or path.is_file()  # a pipe or a device is not
    if (not path.exists() or os.access(path, os.W_OK)) and (not renamed_over or os.access(folder, os.W_OK | os.X_OK)):
        return ""
    if hasattr(os, "statvfs") and os.statvfs(folder).f_flag & os.ST_RDONLY:  # Windows has none
        return os.strerror(errno.EROFS)
    return os.strerror(errno.EACCES)


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Yield the temporary path of ``path``, after sweeping the folder. At the end, remove it if it still exists."""
    _sweep(path.parent)
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}.unfinished")
    with nullcontext() if fcntl is not None else _created(_lock_beside(unfinished), 0o600):
        try:
            yield unfinished
        finally:
            _remove(unfinished)
    if fcntl is None:
        _remove(_lock_beside(unfinished))


def _lock_beside(unfinished: Path) -> Path:
    """Return the path of the lock of an unfinished file or folder on Windows."""
    return unfinished.with_suffix(".lock")


@contextmanager
def _created(path: Path, mode: int) -> Iterator[int]:
    """Create a file and lock it; yield its descriptor."""
    held, _ = _open_locked(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, mode)
    try:
        yield held
    finally:
        os.close(held)


def _pass_on(before: os.stat_result, held: int) -> None:
    """Give a file the owner and mode of the file that it replaces. If the group differs, it gets no permissions."""
    mode = stat.S_IMODE(before.st_mode)
    with suppress(OSError):
        os.fchown(held, before.st_uid, -1)
    with suppress(OSError):
        os.fchown(held, -1, before.st_gid)
    if os.fstat(held).st_gid != before.st_gid:
        mode &= ~0o070
    os.fchmod(held, mode)


def _open_locked(path: Path, flags: int, mode: int = 0o666) -> tuple[int, bool]:
    """Open a file and lock it; return its descriptor, and False if another process holds the lock.

    If another process removes the file before it is locked, it is opened again.
    """
    while True:
        held = os.open(path, flags | _AS_IT_IS, mode)
        locked = _lock(held) is not False
        with suppress(FileNotFoundError):
            if not locked or os.path.samestat(os.fstat(held), path.stat()):
                return held, locked
        os.close(held)


def _lock(descriptor: int) -> bool | None:
    """Lock an open file. Return False if another process holds the lock, and None if locks are not supported."""
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            os.lseek(descriptor, _FAR, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
            os.lseek(descriptor, 0, os.SEEK_SET)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None
    return True


def _sweep(folder: Path) -> None:
    """Remove the unfinished files of killed processes from a folder, once per process."""
    if folder in _swept:
        return
    _swept.add(folder)
    with suppress(OSError):
        for name in os.listdir(folder):
            if _LEFTOVER.fullmatch(name) and _is_abandoned(folder / name):
                _remove(folder / name)
                if fcntl is None:
                    _remove(_lock_beside(folder / name))


def _is_abandoned(path: Path) -> bool:
    """Return whether an unfinished file or folder is not locked."""
    try:
        held = os.open(path if fcntl is not None else _lock_beside(path), os.O_RDONLY | _AS_IT_IS)
    except FileNotFoundError:
        return fcntl is None
    except OSError:
        return False
    try:
        kind = os.fstat(held).st_mode
        return (stat.S_ISREG(kind) or stat.S_ISDIR(kind)) and _lock(held) is True
    finally:
        os.close(held)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


@cache
def _warn_not_synced(reason: str) -> None:
    logging.getLogger(__name__).warning(
        "folders cannot be synced to disk here (%s): an old file may reappear after a power failure",
        reason,
    )


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY if fcntl is not None else os.O_RDWR)  # Windows syncs what can be written
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _copied_to(device: Path) -> Iterator[Path]:
    """Yield a temporary path, and copy what is written there into a pipe or device."""
    with TemporaryDirectory() as folder:
        yield Path(folder, device.name)
        with Path(folder, device.name).open("rb") as source, device.open("wb") as target:
            shutil.copyfileobj(source, target)


def _fault(message: str, path: str | Path) -> Exception:
    return SpecError(message, Where(str(path)))


def _unwritable(reason: object, path: str | Path) -> Exception:
    return SpecError(f"cannot be written: {reason}", Where(str(path)), Code.UNWRITABLE, (reason,))
