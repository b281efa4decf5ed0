"""The judge: knows places and no networks. What is the same place, which descriptors tell it, and how well.

``LoopDetector`` is loaded when it is first used, so that reading a trajectory loads nothing else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from loopclosure.detector.detector import LoopDetector, LoopResult

__all__ = ["LoopDetector", "LoopResult"]


__path__.append(f"{__path__[0]}/moved")  # loopclosure.baselines, by the name it had before


def __getattr__(name: str) -> Any:
    if name in __all__:
        from loopclosure.detector import detector

        return getattr(detector, name)
    raise AttributeError(f"module 'loopclosure' has no attribute {name!r}")
