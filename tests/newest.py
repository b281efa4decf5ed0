"""The result of a frame that is added to a detector, a loop or not."""

from collections.abc import Callable
from typing import Any

from loopclosure import LoopResult


def newest(add: Callable[..., list[LoopResult]], *frame: Any, **known: Any) -> LoopResult:
    """Add a frame by a method of a detector or visitor, and return its result."""
    add(*frame, **known)
    return getattr(add, "__self__").newest  # noqa: B009
