"""How idle OpenMP threads wait.

Each OpenMP runtime reads it from the environment when torch is loaded. GNU's has threads spin 150 times as long as set
here, which takes the cores from other programs; threads that do not spin at all are woken for every layer, which
doubles the time of small ones (``tools/bench waiting``).
"""

from __future__ import annotations

import os
import sys

VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
CHOICE = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "2000"}
_torch_came_first = False


def sleep_soon() -> None:
    """Have idle threads soon fall asleep, unless torch is loaded already; a user's choice stays."""
    global _torch_came_first
    if any(name in os.environ for name in VARIABLES):
        return
    _torch_came_first = "torch" in sys.modules
    if not _torch_came_first:
        os.environ.update(CHOICE)


def how() -> str:
    """Return how idle threads wait, for a report."""
    if _torch_came_first:
        return "the runtime's own way: torch was imported before netspec"
    return _set({name: os.environ[name] for name in VARIABLES if name in os.environ}, ", ")


def too_late(threads: int) -> str:
    """Return what to say of a training whose ``threads`` wait in the runtime's own way; "" if they do not."""
    if not _torch_came_first or threads < 2:
        return ""
    return (
        "torch was imported before netspec: idle threads may keep cores from other programs. To prevent it, import "
        f"netspec first, or set {_set(CHOICE, ' and ')}"
    )


def _set(variables: dict[str, str], between: str) -> str:
    return between.join(f"{name}={value}" for name, value in variables.items())
