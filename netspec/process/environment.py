"""Environment variables that must stand while a library is loaded: set around that, and put back afterwards.

These are all: the most pixels of an image, for OpenCV (netspec/files/opencv.py), OpenBLAS's kernels, for SciPy, and
what threadpoolctl (netspec/exact/blas.py) and torch's report (netspec/inspect/check/bug_report.py) set themselves.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables within the block, but for those that the user has set; then they are as before."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update({name: value for name, value in variables.items() if before[name] is None})
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
