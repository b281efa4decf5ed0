"""Takes away what Windows does not have. Python imports this file at its start, in child processes too.

Put its folder on PYTHONPATH. What stays is Linux: paths, signals and ``sys.platform`` are not simulated.
"""

from __future__ import annotations

import errno
import fcntl
import multiprocessing
import multiprocessing.context
import os
import shutil
import signal
import stat
import subprocess  # noqa: F401  before msvcrt: it would take the system for Windows
import sys
import tempfile
import types
import warnings
from collections.abc import Callable
from typing import Any

_flock, _flags, _open = fcntl.flock, fcntl.fcntl, os.open


def _refuse(number: int, *names: Any) -> OSError:
    return OSError(number, os.strerror(number), *names)


def _is_folder(path: Any) -> bool:
    try:
        return stat.S_ISDIR(os.stat(path).st_mode)
    except (OSError, ValueError):
        return False


def _open_files(path: str) -> bool:
    """Return whether this process holds a file open at ``path`` or below it."""
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            name = os.readlink(f"/proc/self/fd/{descriptor}")
        except OSError:
            continue
        if name == path or name.startswith(f"{path}/"):
            return True
    with open("/proc/self/maps", encoding="utf-8") as maps:
        return any(line.rstrip().endswith(path) for line in maps)


def _unless_open(call: Callable[..., Any], paths: int, overwrites: bool = True) -> Callable[..., Any]:
    """Return a function that refuses paths with open files: its first one, or its first two."""

    def refusing(*given: Any, **options: Any) -> Any:
        names = [os.fsdecode(name) for name in given[:paths]]
        if any(_open_files(os.path.realpath(name)) for name in names):
            raise PermissionError(errno.EACCES, "The process cannot access the file, it is being used", *names[:1])
        if not overwrites and os.path.lexists(names[1]):
            raise FileExistsError(errno.EEXIST, "Cannot create a file when that file already exists", names[1])
        if overwrites and paths == 2 and _is_folder(names[1]):
            raise PermissionError(errno.EACCES, "Access is denied", names[1])
        return call(*given, **options)

    return refusing


def _open_no_folder(path: Any, flags: int, *given: Any, **options: Any) -> int:
    if _is_folder(path):
        raise _refuse(errno.EACCES, path)
    return _open(path, flags, *given, **options)


def _sync(file: Any, sync: Callable[[int], None] = os.fsync) -> None:
    descriptor = file if isinstance(file, int) else file.fileno()
    if _flags(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise _refuse(errno.EBADF)
    sync(descriptor)


def _no_link(source: Any, target: Any, *_: Any, **__: Any) -> None:
    raise OSError(errno.EPERM, "A required privilege is not held by the client", target)


def _locking(descriptor: int, mode: int, count: int) -> None:
    """msvcrt.locking, by the locks that Linux has: they end with the descriptor, too."""
    try:
        _flock(descriptor, fcntl.LOCK_UN if mode == 0 else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise PermissionError(errno.EACCES, "Permission denied") from None


def _take_away() -> None:
    for module in ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty"):
        sys.modules[module] = None  # type: ignore[assignment]
    locks = types.ModuleType("msvcrt")
    locks.__dict__.update(locking=_locking, LK_UNLCK=0, LK_NBLCK=2)
    sys.modules["msvcrt"] = locks
    for name in (
        "fork", "forkpty", "sched_getaffinity", "sysconf", "statvfs", "fchown", "chown",
        "geteuid", "mkfifo", "confstr", "O_NOFOLLOW", "O_NONBLOCK", "O_DIRECTORY",
    ):  # fmt: skip
        if hasattr(os, name):
            delattr(os, name)
    os.supports_dir_fd = set()
    del signal.SIGHUP
    os.symlink, os.open, os.fsync = _no_link, _open_no_folder, _sync
    os.unlink = os.remove = _unless_open(os.unlink, 1)
    os.rename, os.replace = _unless_open(os.rename, 2, overwrites=False), _unless_open(os.replace, 2)
    shutil._use_fd_functions = False  # type: ignore[attr-defined]
    tempfile.TemporaryFile = tempfile.NamedTemporaryFile  # as on Windows: the other one removes an open file
    contexts: dict[str, Any] = vars(multiprocessing.context)["_concrete_contexts"]
    for name in set(contexts) - {"spawn"}:
        del contexts[name]
    multiprocessing.get_all_start_methods = lambda: ["spawn"]
    multiprocessing.set_start_method("spawn", force=True)


_take_away()
if sys.flags.warn_default_encoding:
    warnings.simplefilter("ignore", EncodingWarning)
    for package in ("netspec", "loopclosure", "lmdb_build"):
        warnings.filterwarnings("error", "'encoding'", EncodingWarning, rf"{package}\b")
