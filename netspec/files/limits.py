"""The memory of this process, its limits, and limits on the sizes that files declare."""

from __future__ import annotations

import ctypes
import errno
import gc
import gzip
import io
import os
import re
import stat
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ALWAYS_ALLOWED = 1 << 28  # bytes that a file of any size may declare
LIMIT = "NETSPEC_LIMIT"  # the variable by which ``netspec run --limit`` reaches the processes of a program
MOST_PACKED = 100  # times a file's size: real data is compressed 2 to 20 times, a malicious file 1000 times

# What torch says; a user's layer may say "cannot allocate" of something else.
_OF_TORCH = ("DefaultCPUAllocator", "out of memory", "size calculation overflowed", "integer multiplication overflow")
_UNITS = {"": 0, "k": 10, "m": 20, "g": 30, "t": 40}
_CONTAINER = Path("/sys/fs/cgroup/memory.max")  # Linux: the limit of a container, a number or "max"


def memory() -> int:
    """Return the bytes of the machine's memory, or 8 GiB if the system does not report it.

    In a container, return the container's limit.
    """
    try:
        machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return 8 << 30
    try:
        return min(machine, int(_CONTAINER.read_text("ascii")))
    except (ValueError, OSError):  # no limit, or no container
        return machine


def is_out_of_memory(fault: BaseException) -> bool:
    """Return whether an exception means that memory ran out, or a size is impossible. Torch raises RuntimeError."""
    if isinstance(fault, RuntimeError):
        return any(words in str(fault) for words in _OF_TORCH)
    return isinstance(fault, MemoryError)


def give_back_freed_memory() -> None:
    """Return freed memory between used blocks to the system (glibc: malloc_trim; nothing in other C libraries).

    Runs on inputs of many sizes leave such gaps: a net of six convolutions that had run with 70 batch sizes held five
    times the memory that it used.
    """
    if sys.platform.startswith("linux") and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)


@contextmanager
def no_collection() -> Iterator[None]:
    """Pause Python's garbage collector within the block. While a large net grows, it would visit all objects often.

    Afterwards, also after an error, the collector is as before. Objects outside of reference cycles are still freed.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a file or pipe, decompressed if the name ends in .gz.

    Raises OSError, also for a device, because it may be endless.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "a file name cannot contain a NUL character", str(path))
    with open(path, "rb") as file:
        if stat.S_ISCHR(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.ENODEV, "it is a device, not a file", str(path))
        data = file.read()
    if not str(path).endswith(".gz") or not data.startswith(b"\x1f\x8b"):
        return data
    try:
        unpacked = gzip.GzipFile(fileobj=io.BytesIO(data)).read(max(ALWAYS_ALLOWED, MOST_PACKED * len(data)) + 1)
    except (EOFError, zlib.error) as fault:
        raise OSError(errno.EINVAL, f"a damaged gzip file: {fault}", str(path)) from None
    if fault := bomb(len(unpacked), len(data)):
        raise OSError(errno.EFBIG, fault, str(path))
    return unpacked


def bomb(size: int, stored: int) -> str:
    """Return an error if ``size`` bytes of data in a file of ``stored`` bytes are implausible, or ""."""
    if size <= ALWAYS_ALLOWED or (size <= MOST_PACKED * stored and size <= memory()):
        return ""
    return f"would take {amount(size)} of memory, but the file has only {amount(stored)}; it was not read"


def read_amount(text: str) -> int:
    """Return the bytes of ``16GiB``, ``16G``, ``1.5 T`` or ``1000000``. Raises ValueError for anything else."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?([kmgt]?)(?:i?b)?", text.strip(), re.IGNORECASE)
    if not match:
        raise ValueError(f"found {text!r}, expected a size, e.g. 16GiB")
    return int(float(match[1]) * (1 << _UNITS[match[2].lower()]))


def amount(size: int) -> str:
    """Return a number of bytes as text, such as ``1.5 GiB``."""
    for power, unit in ((60, "EiB"), (50, "PiB"), (40, "TiB"), (30, "GiB"), (20, "MiB"), (10, "KiB")):
        if size >= 1 << power:
            return f"{size / (1 << power):.3g} {unit}"
    return f"{size} bytes"
