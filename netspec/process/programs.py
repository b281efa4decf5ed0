"""What a program does to its process before anything else. A library leaves its process as it is."""

from __future__ import annotations

from netspec.process import waiting


def set_up() -> None:
    """Set up this process for a program of netspec: idle threads soon sleep. Before torch is loaded."""
    waiting.sleep_soon()
