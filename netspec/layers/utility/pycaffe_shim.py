"""The module ``caffe`` for the code of Python layers: Layer, TRAIN, TEST.

Caffe: python/caffe/_caffe.cpp
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, NoReturn

from netspec.layers.utility.live_blobs import Blob, BlobVec

TRAIN, TEST = 0, 1


class Layer:
    """Base of users' layers, which add forward(bottom, top) and backward(top, propagate_down, bottom)."""

    param_str: str
    phase: int
    type = "Python"

    def __init__(self, param: Any) -> None:
        """Make a layer without blobs; ``param`` is its LayerParameter."""
        self.blobs = BlobVec()

    def setup(self, bottom: list[Blob], top: list[Blob]) -> None:
        """Prepare the layer; called once."""

    def reshape(self, bottom: list[Blob], top: list[Blob]) -> None:
        """Set the shapes of the tops."""


def __getattr__(name: str) -> NoReturn:
    raise AttributeError(f"netspec's module caffe for Python layers has no {name}; it has Layer, TRAIN and TEST")


_home = __name__  # the module that Python layers import as ``caffe``
_finders: tuple[Any, ...] = ()  # of modules inside it


def offer(package: str, finder: Any) -> None:
    """Let Python layers import a package as ``caffe`` instead of this module; ``finder`` finds its submodules."""
    global _home, _finders
    _home, _finders = package, (finder,)


@contextmanager
def importable() -> Iterator[None]:
    """Within the block, code can import modules of the current directory, and ``caffe`` even if it is not installed."""
    directory = os.getcwd()
    sys.path.insert(0, directory)
    stand_in = "caffe" not in sys.modules and not _is_installed(directory)
    finders = _finders
    if stand_in:
        sys.modules["caffe"] = importlib.import_module(_home)
        sys.meta_path[:0] = finders
    try:
        yield
    finally:
        sys.path.remove(directory)
        if stand_in:
            for finder in finders:
                sys.meta_path.remove(finder)
            for name in [name for name in sys.modules if name == "caffe" or name.startswith("caffe.")]:
                del sys.modules[name]


def can_import(module: str) -> bool:
    """Return whether a module can be found, without running it. Its parent package is imported."""
    with importable():
        try:
            return importlib.util.find_spec(module) is not None
        except Exception:  # the code of its package may raise anything
            return False


@cache
def _is_installed(directory: str) -> bool:
    """Return whether a directory has a package caffe. A folder with Caffe's sources does not count."""
    spec = importlib.util.find_spec("caffe")
    return spec is not None and spec.origin is not None
