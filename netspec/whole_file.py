"""Files that appear whole or not at all: a run that dies while it writes leaves what was there before."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from netspec.errors import SpecError, Where


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield a name beside ``path`` to write to; the file gets its own name once the block is done and all is on disk.

    Raises SpecError where it cannot be written. If the block fails, nothing is left behind.
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
