"""Lets ``import caffe`` and its submodules find :mod:`netspec.pycaffe`."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

from netspec.compat.alias import Alias, AliasFinder

NAME = "caffe"
HOME = "netspec.compat.pycaffe"


def install() -> None:
    """Let ``import caffe`` find netspec.pycaffe from now on."""
    uninstall()
    sys.meta_path.insert(0, CaffeFinder(NAME, HOME))


def uninstall() -> None:
    """Undo :func:`install`. Modules that were imported stay."""
    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, CaffeFinder)]


def package() -> ModuleType:
    """Return netspec.pycaffe. Its folders include ``caffe`` of Caffe's trees on ``sys.path``, for caffe.model_libs."""
    module = importlib.import_module(HOME)
    module.__path__ = pkgutil.extend_path(module.__path__, NAME)
    return module


class CaffeFinder(AliasFinder):
    """Finds ``caffe`` and its submodules."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the spec of such a module, or None for all others."""
        if name != self.name:
            return super().find_spec(name, path, target)
        package()
        return ModuleSpec(name, Alias(self.home), is_package=True)
