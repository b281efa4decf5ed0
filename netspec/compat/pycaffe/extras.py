"""Packages that only some programs need."""

from __future__ import annotations

import importlib
from typing import Any

DISTRIBUTIONS = {"skimage": "scikit-image", "pydot": "pydot", "fissix": "fissix"}


def load(module: str, extra: str, purpose: str) -> Any:
    """Import a module of an extra. Raises ImportError with one line that says what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as fault:
        name = DISTRIBUTIONS[module.partition(".")[0]]
        message = f"{purpose} needs {name}: pip install {name}, or pip install 'netspec-caffe[{extra}]'"
        raise ImportError(message) from fault
