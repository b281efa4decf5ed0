"""What the commands share besides netspec.terminal: progress bars and warnings."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from tqdm import tqdm

from loopclosure.progress import Item
from netspec.errors import printable


def warn(doubt: str) -> None:
    """Print a doubt about the user's files."""
    print(printable(f"warning: {doubt}"), file=sys.stderr)


def show_progress(items: Iterable[Item], stage: str, total: int | None = None) -> Iterable[Item]:
    """Show a bar on a terminal."""
    return tqdm(items, desc=stage, total=total, disable=None, leave=False, unit="")
