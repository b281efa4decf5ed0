"""What a command shows while it works: bars on a terminal, and doubts about the user's files."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TypeVar

from netspec.errors import printable

Item = TypeVar("Item")


def bar(items: Iterable[Item], stage: str, total: int | None = None, unit: str = "") -> Iterable[Item]:
    """Return the items; on a terminal, a bar named ``stage`` shows how far the caller is in them."""
    from tqdm import tqdm  # commands that show no bar do not load it

    return tqdm(items, desc=stage, total=total, disable=None, leave=False, unit=unit)


def warn(doubt: str) -> None:
    """Print a doubt about the user's files."""
    print(printable(f"warning: {doubt}"), file=sys.stderr)
