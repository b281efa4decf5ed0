"""Settings that a program makes for its whole process. A library must not make them."""

from __future__ import annotations

import os
import signal
from functools import cache

# How idle OpenMP threads wait. By default, GNU's runtime lets them spin 150 times as long as set here, which takes the
# cores from other programs. Threads that do not spin are woken for every layer, which doubles the time of small ones.
WAITING = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "2000"}

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # malloc.h: M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
_LARGEST = 32 * 2**20  # bytes: the largest block that glibc takes from its heap, DEFAULT_MMAP_THRESHOLD_MAX
_MALLOC_SETTINGS = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


def set_up() -> None:
    """Let idle OpenMP threads of this process, and of processes that it starts, sleep soon.

    Variables that the user has set are kept. Call it before torch is imported, because OpenMP reads them then.
    """
    if not any(name in os.environ for name in (*WAITING, "KMP_BLOCKTIME")):
        os.environ.update(WAITING)


@cache
def keep_freed_memory() -> None:
    """Let glibc keep freed memory for the next iteration, in blocks of up to 32 MB.

    Otherwise the system clears each page before the process gets it again, which can take 5 % of the time of a training
    on a CPU. Settings in the user's environment, and other C libraries, are not changed.
    """
    import ctypes

    if any(name in os.environ for name in _MALLOC_SETTINGS) or "CS_GNU_LIBC_VERSION" not in os.confstr_names:
        return
    library = ctypes.CDLL(None)
    library.mallopt(_MMAP_THRESHOLD, _LARGEST)
    library.mallopt(_TRIM_THRESHOLD, 2**31 - 1)


@cache
def end_forked_processes_by_sigterm() -> None:
    """Let SIGTERM end every process that is forked from now on, even if netspec handles SIGTERM in this process.

    A forked process inherits signal handlers. netspec's handlers wait for things that only the parent does, such as the
    end of an iteration. Python layers and scripts end their workers by SIGTERM, and then wait for them.
    """
    os.register_at_fork(after_in_child=_end_by_sigterm)


def _end_by_sigterm() -> None:
    handler = signal.getsignal(signal.SIGTERM)
    if getattr(handler, "__module__", "").startswith("netspec."):
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
