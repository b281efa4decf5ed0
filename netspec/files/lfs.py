"""Git LFS pointers: the few lines of text that a clone without Git LFS has in the place of each large file."""

from __future__ import annotations

import os
import re

_POINTER = re.compile(rb"version https://git-lfs\.github\.com/spec/v1\s.*?^size (\d+)\s*$", re.DOTALL | re.MULTILINE)
_LONGEST = 1024  # bytes; https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md


def pointer_fault(data: bytes) -> str:
    """Return what to say of a file that begins with these bytes where it is a pointer, and "" where it is not."""
    match = _POINTER.match(data[:_LONGEST])
    if not match:
        return ""
    remedy = "run `git lfs pull` in its repository, or download the file itself"
    return f"is a Git LFS pointer to a file of {int(match[1]):,} bytes, not that file; {remedy}"


def pointer_fault_at(path: str | os.PathLike[str]) -> str:
    """Return :func:`pointer_fault` of a file, and "" where it cannot be read."""
    try:
        with open(path, "rb") as file:
            return pointer_fault(file.read(_LONGEST))
    except (OSError, ValueError):  # a path with a NUL
        return ""
