"""Loop closure: which images show the same place, and how well a method finds them. It uses no networks.

The public names are loaded when they are first used, so that importing one of them does not import all.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from loopclosure.closing.locate import Locator
    from loopclosure.closing.measure import Loop
    from loopclosure.closing.online import LoopCloser
    from loopclosure.closing.synchronizer import Synchronizer
    from loopclosure.commands import close, detect, evaluate
    from loopclosure.descriptors.thumbnails import Thumbnailer
    from loopclosure.detector.decision import LoopResult
    from loopclosure.detector.detector import LoopDetector
    from loopclosure.detector.map import Map
    from loopclosure.detector.verification import GeometricCheck
    from loopclosure.detector.visitor import Visitor
    from loopclosure.places import messages
    from loopclosure.places.intrinsics import Intrinsics as Camera
    from loopclosure.places.sequences import read_sequence

_HOMES = {
    "Camera": "loopclosure.places.intrinsics:Intrinsics",
    "GeometricCheck": "loopclosure.detector.verification:GeometricCheck",
    "Locator": "loopclosure.closing.locate:Locator",
    "Loop": "loopclosure.closing.measure:Loop",
    "LoopCloser": "loopclosure.closing.online:LoopCloser",
    "LoopDetector": "loopclosure.detector.detector:LoopDetector",
    "LoopResult": "loopclosure.detector.decision:LoopResult",
    "Map": "loopclosure.detector.map:Map",
    "Synchronizer": "loopclosure.closing.synchronizer:Synchronizer",
    "Thumbnailer": "loopclosure.descriptors.thumbnails:Thumbnailer",
    "Visitor": "loopclosure.detector.visitor:Visitor",
    "close": "loopclosure.commands:close",
    "detect": "loopclosure.commands:detect",
    "evaluate": "loopclosure.commands:evaluate",
    "messages": "loopclosure.places.messages",
    "read_sequence": "loopclosure.places.sequences:read_sequence",
}

__all__ = [
    "Camera",
    "GeometricCheck",
    "Locator",
    "Loop",
    "LoopCloser",
    "LoopDetector",
    "LoopResult",
    "Map",
    "Synchronizer",
    "Thumbnailer",
    "Visitor",
    "close",
    "detect",
    "evaluate",
    "messages",
    "read_sequence",
]


def __getattr__(name: str) -> "Any":
    if name not in _HOMES:
        raise AttributeError(f"module 'loopclosure' has no attribute {name!r}")
    from importlib import import_module

    module, _, attribute = _HOMES[name].partition(":")
    return getattr(import_module(module), attribute) if attribute else import_module(module)
