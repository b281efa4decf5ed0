"""Environment variables that must stand while a library is loaded: set around that, and put back afterwards.

These are all: the most pixels of an image, for OpenCV (netspec/files/opencv.py), OpenBLAS's kernels, for SciPy, and
what threadpoolctl sets itself (netspec/exact/blas.py).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables within the block, but for those that the user has set."""
    ours = {name: value for name, value in variables.items() if name not in os.environ}
    os.environ.update(ours)
    try:
        yield
    finally:
        for name in ours:
            os.environ.pop(name, None)
