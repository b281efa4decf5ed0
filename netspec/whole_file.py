"""Files that are written atomically: if a run dies while it writes, the old file is still there.

Also a check, before a long run, whether a file can be written.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from netspec.errors import SpecError, Where


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path`` to write to; it is renamed once the block is done and all is on disk.

    Raises SpecError if it cannot be written. If the block fails, the temporary file is removed.
    """
    path = Path(path)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.unfinished")
    try:
        yield unfinished
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        unfinished.replace(path)
    except OSError as fault:
        reason = os.strerror(fault.errno) if fault.errno else fault  # h5py's own text is a paragraph
        raise SpecError(f"cannot be written: {reason}", Where(str(path))) from None
    finally:
        unfinished.unlink(missing_ok=True)


def why_unwritable(path: str | Path) -> str:
    """Return why no file can be written at ``path``, in the words of the operating system; "" if one can.

    Nothing is written; only the path and its permissions are checked: a full disk, for example, is not detected.
    """
    path = Path(path)
    folder = path.parent
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
    if os.access(path, os.W_OK) if path.exists() else os.access(folder, os.W_OK | os.X_OK):
        return ""
    return os.strerror(errno.EROFS if os.statvfs(folder).f_flag & os.ST_RDONLY else errno.EACCES)
