"""The process of a training, on this machine: whether it runs, and how much memory it takes."""

from __future__ import annotations

import re
from pathlib import Path

_TRAINERS = re.compile(rb"caffe|netspec|train")


def is_alive(process: int) -> bool | None:
    """Return whether a training with this process number runs; None where the system does not tell (no /proc)."""
    if not Path("/proc/self").exists():
        return None
    try:
        words = Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False
    return _TRAINERS.search(words) is not None  # else the number is another program's by now


def memory_of(process: int) -> tuple[int, int] | None:
    """Return the bytes of memory that a process takes now and took at most; None where the system does not tell."""
    try:
        text = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return None
    found = {name: int(size) << 10 for name, size in re.findall(r"^(VmRSS|VmHWM):\s+(\d+) kB", text, re.M)}
    return (found["VmRSS"], found["VmHWM"]) if len(found) == 2 else None
