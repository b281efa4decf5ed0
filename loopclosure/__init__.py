"""Loop closure: which images show the same place, and how well a method finds them. It uses no networks.

``LoopDetector`` is imported when it is first used, so that importing one module does not import all of them.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from loopclosure.detector.decision import LoopResult
    from loopclosure.detector.detector import LoopDetector

__all__ = ["LoopDetector", "LoopResult"]


def __getattr__(name: str) -> "Any":
    if name in __all__:
        from loopclosure.detector import detector

        return getattr(detector, name)
    raise AttributeError(f"module 'loopclosure' has no attribute {name!r}")
