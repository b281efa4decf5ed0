"""What ``import caffe`` gives to the code of a Python layer where no pycaffe is installed: Layer, TRAIN, TEST.

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
from netspec.process.alias import AliasFinder

TRAIN, TEST = 0, 1


class Layer:
    """Base of the layers that people write: they add forward(bottom, top), backward(top, propagate_down, bottom)."""

    param_str: str
    phase: int
    type = "Python"

    def __init__(self, param: Any) -> None:
        """Make a layer without blobs; ``param`` is its LayerParameter."""
        self.blobs = BlobVec()

    def setup(self, bottom: list[Blob], top: list[Blob]) -> None:
        """Do what is to be done once."""

    def reshape(self, bottom: list[Blob], top: list[Blob]) -> None:
        """Give the tops their shapes."""


def __getattr__(name: str) -> NoReturn:
    raise AttributeError(f"netspec's replacement for pycaffe has no {name}; it has Layer, TRAIN and TEST")


_home = __name__  # of what ``import caffe`` gives


def offer(package: str) -> None:
    """Let the code of Python layers import a package, with what is in it, as ``caffe`` in place of this module."""
    global _home
    _home = package


@contextmanager
def importable() -> Iterator[None]:
    """Let code import the stand-in as ``caffe``, unless there is a real one, and modules of the current directory."""
    directory = os.getcwd()
    sys.path.insert(0, directory)
    stand_in = "caffe" not in sys.modules and not _is_installed(directory)
    finder = AliasFinder("caffe", _home)
    if stand_in:
        sys.modules["caffe"] = importlib.import_module(_home)
        sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.path.remove(directory)
        if stand_in:
            sys.meta_path.remove(finder)
            for name in [name for name in sys.modules if name == "caffe" or name.startswith("caffe.")]:
                del sys.modules[name]


def can_import(module: str) -> bool:
    """Say whether code would find a module, without running it; a package that it lies in is imported."""
    with importable():
        try:
            return importlib.util.find_spec(module) is not None
        except Exception:  # its package's code may raise anything
            return False


@cache
def _is_installed(directory: str) -> bool:
    """Say whether Python, run in a directory, finds a caffe; a mere folder of that name (Caffe's sources) is none."""
    spec = importlib.util.find_spec("caffe")
    return spec is not None and spec.origin is not None
