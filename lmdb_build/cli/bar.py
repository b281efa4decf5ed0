"""Progress bars on a terminal."""

from __future__ import annotations

from collections.abc import Iterable

from tqdm import tqdm

from loopclosure.progress import Item


def bar(items: Iterable[Item], stage: str, total: int | None = None) -> Iterable[Item]:
    """Return the items with a progress bar around them; a :class:`loopclosure.progress.Progress`."""
    return tqdm(items, desc=stage, total=total, disable=None, unit="")
