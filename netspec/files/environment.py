"""Environment variables that a library reads when it is loaded.

Used for OpenCV's limit on pixels (netspec/files/opencv.py) and the kernels of SciPy's OpenBLAS (netspec/exact/blas.py).
threadpoolctl sets variables itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables within the block, except those that are already set. Afterwards, restore them all."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update({name: value for name, value in variables.items() if before[name] is None})
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
