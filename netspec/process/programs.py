"""What a program does to its process before anything else. A library leaves its process as it is."""

from __future__ import annotations

import os

# How idle OpenMP threads wait. GNU's runtime has them spin 150 times as long as set here, which takes the cores from
# other programs; threads that do not spin at all are woken for every layer, which doubles the time of small ones
# (``tools/bench waiting``).
WAITING = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "2000"}


def set_up() -> None:
    """Have idle threads of this process, and of those it starts, soon sleep; a user's choice stays.

    Call it before torch is imported: OpenMP reads these variables then.
    """
    if not any(name in os.environ for name in (*WAITING, "KMP_BLOCKTIME")):
        os.environ.update(WAITING)
