"""Recognizes wrong files by their first bytes, and truncated PNG files.

A Git LFS pointer is a short text that replaces a large file in a clone made without Git LFS.
"""

from __future__ import annotations

import difflib
import os
import re
from pathlib import Path

_POINTER = re.compile(rb"version https://git-lfs\.github\.com/spec/v1\s.*?^size (\d+)\s*$", re.DOTALL | re.MULTILINE)
_LONGEST = 1024  # bytes; https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md


def pointer_fault(data: bytes) -> str:
    """Return the error for a file that begins with these bytes if it is a Git LFS pointer, else ""."""
    match = _POINTER.match(data[:_LONGEST])
    if not match:
        return ""
    remedy = "run `git lfs pull` in its repository, or download the file itself"
    return f"is a Git LFS pointer to a file of {int(match[1]):,} bytes, not the file itself; {remedy}"


def head_of(path: str | os.PathLike[str]) -> bytes:
    """Return the first bytes of a file, or b"" if it is not a regular file or cannot be read."""
    try:
        with open(path if os.path.isfile(path) else os.devnull, "rb") as file:
            return file.read(_LONGEST)
    except (OSError, ValueError):  # a path with a NUL
        return b""


HDF5 = b"\x89HDF\r\n\x1a\n"
_COPY = "copy its arrays into net.params[LAYER], then netspec.save_weights"
_KINDS = {
    b"\x1f\x8b": "a gzip file",
    b"\xff\xd8\xff": "a JPEG image",
    b"\x89PNG": "a PNG image",
    b"PK\x03\x04": f"a ZIP archive, as .npz and PyTorch's .pth are; {_COPY}",
    b"\x80\x02": f"a pickle, as old .pth files are; {_COPY}",
    b"\x93NUMPY": f"a NumPy array; {_COPY}",
    HDF5: "an HDF5 file; its name should end in .h5",
    b"<!doctype html": "a web page: the download failed; open it in a browser",
    b"<html": "a web page: the download failed; open it in a browser",
}


def is_safetensors(data: bytes) -> bool:
    """Return whether a file that begins with these bytes is a safetensors file: a length and a JSON object."""
    return len(data) > 9 and data[8:9] == b"{" and int.from_bytes(data[:8], "little") < 1 << 30


def kind_of(data: bytes) -> str:
    """Return the kind of a file that begins with these bytes, with advice, or "" if it is unknown."""
    if is_safetensors(data):
        return "a .safetensors file"
    start = data[:64].lstrip().lower() if data[:1].isspace() or data[:1] == b"<" else data[:64]
    return next((kind for magic, kind in _KINDS.items() if start.startswith(magic)), "")


def unreadable(path: object, fault: OSError | ValueError, expected: str = "") -> str:
    """Return why a file cannot be read and what was ``expected``; for a missing file also the nearest existing path."""
    text = str(path)
    if "://" in text or text.startswith(("http:/", "https:/")):
        return "is a web address; download the file and give its path"
    reason = f"cannot be read: {getattr(fault, 'strerror', None) or fault}"
    if expected:
        reason = f"{reason}; expected {expected}"
    return f"{reason}{nearest_existing(text)}" if isinstance(fault, FileNotFoundError) else reason


def nearest_existing(path: str | os.PathLike[str]) -> str:
    """Return advice for a missing path: the part that exists, a similar name, and where relative paths start."""
    missing = Path(path)
    while not os.path.exists(missing.parent):
        missing = missing.parent
    try:
        stems = {
            Path(name).stem: name for name in os.listdir(missing.parent)
        }  # a common suffix does not count as similarity
    except OSError:  # not a folder, or not readable
        stems = {}
    close = difflib.get_close_matches(missing.stem, stems, n=1)
    found = f'; "{missing.parent}" has no "{missing.name}"' if missing != Path(path) else ""
    found += f'; did you mean "{missing.parent / stems[close[0]]}"?' if close else ""
    return found if Path(path).is_absolute() else f"{found}; relative paths start from {os.getcwd()}"


def is_cut_png(data: bytes) -> bool:
    """Return whether data is a PNG file with a chunk that declares more bytes than the file has.

    OpenCV allocates the declared size, up to 4 GiB, before it reads the chunk.
    """
    at = 8 if data.startswith(b"\x89PNG\r\n\x1a\n") else len(data)
    while at < len(data):
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return at > len(data)
