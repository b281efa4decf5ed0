"""How idle OpenMP threads wait in programs.

Each OpenMP runtime reads it from the environment when torch is loaded. GNU's has threads spin 150 times as long as set
here, which takes the cores from other programs; threads that do not spin at all are woken for every layer, which
doubles the time of small ones (``tools/bench waiting``).
"""

from __future__ import annotations

import os
import sys
from typing import Any

from netspec.process.environment import environment

VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
CHOICE = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "2000"}
TOO_LATE = "torch was imported before"
_state = ""  # "chosen", or TOO_LATE


def sleep_soon() -> None:
    """Have idle threads soon fall asleep once torch is loaded; a user's choice stays."""
    global _state
    if _state or any(name in os.environ for name in VARIABLES):
        return
    _state = TOO_LATE if "torch" in sys.modules else "chosen"
    if _state == "chosen":
        sys.meta_path.insert(0, _Torch())  # type: ignore[arg-type]


class _Torch:
    """Finds torch once, as the others do; while it is loaded, the environment says how threads wait."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> Any:
        if name != "torch":
            return None
        sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, _Torch)]
        from importlib.util import find_spec

        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def exec_module(module: Any) -> None:
                with environment(CHOICE):
                    load(module)

            spec.loader.exec_module = exec_module
        return spec


def how() -> str:
    """Return how idle threads wait, for a report."""
    if _state == "chosen":
        return _set(CHOICE, ", ")
    chosen = {name: os.environ[name] for name in VARIABLES if name in os.environ}
    return _set(chosen, ", ") or "the runtime's own way" + (_state and f": {_state}")


def too_late(threads: int) -> str:
    """Return what to say of a training whose ``threads`` were to sleep soon, and do not; "" otherwise."""
    if _state != TOO_LATE or threads < 2:
        return ""
    return f"{TOO_LATE}: idle threads may keep cores from other programs. To prevent it, set {_set(CHOICE, ' and ')}"


def _set(variables: dict[str, str], between: str) -> str:
    return between.join(f"{name}={value}" for name, value in variables.items())
