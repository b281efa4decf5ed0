"""Access to netspec/fast, which is optional. This file imports nothing, because netspec/__init__.py imports it."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

find: "Callable[[], Any]" = lambda: None  # noqa: E731  # set by netspec/__init__.py


def speed() -> "Any":
    """Return netspec/fast for ``BuildOptions.speed`` (:class:`netspec.run.speed.Speed`); None if it is missing."""
    return find()
