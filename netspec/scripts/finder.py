"""Lets ``import caffe`` and its submodules find :mod:`netspec.pycaffe`, and never in the place of a real Caffe.

A real Caffe is any package or module ``caffe`` on ``sys.path``, but for Caffe's sources without the compiled part:
scripts put these on the path (``sys.path.insert(0, caffe_root + "python")``), and they cannot be imported.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

NAME = "caffe"
HOME = "netspec.pycaffe"
MARK = "# netspec as caffe"  # the first line of what `netspec install-caffe` writes


def install(shadow: bool = False) -> None:
    """Let ``import caffe`` find netspec.pycaffe from now on; with ``shadow`` also where there is a real Caffe."""
    uninstall()
    sys.meta_path.insert(0, CaffeFinder(shadow))


def uninstall() -> None:
    """Undo :func:`install`; what was imported stays."""
    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, CaffeFinder)]


def real_caffe() -> str | None:
    """Return where a real Caffe is that Python finds now, or None."""
    spec = PathFinder.find_spec(NAME, sys.path)
    if spec is None or spec.origin is None:  # a mere folder of that name is none
        return None
    origin = Path(spec.origin)
    if origin.suffix == ".py" and origin.read_text("utf-8", errors="replace").startswith(MARK):
        return None
    sources = origin.name == "__init__.py" and origin.with_name("pycaffe.py").is_file()
    compiled = any(origin.parent.glob("_caffe*.so")) or any(origin.parent.glob("_caffe*.pyd"))
    return None if sources and not compiled else str(origin)


class CaffeFinder(importlib.abc.MetaPathFinder):
    """Finds ``caffe`` and what is in it."""

    def __init__(self, shadow: bool) -> None:
        self.shadow = shadow

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """Return the spec of netspec's module, of another one beside Caffe's sources, or None for Python to look on."""
        if fullname == NAME:
            return self._whole()
        if not fullname.startswith(f"{NAME}.") or not _is_ours(sys.modules.get(NAME)):
            return None
        home = HOME + fullname.removeprefix(NAME)
        if home in sys.modules or importlib.util.find_spec(home):
            return ModuleSpec(fullname, _Alias(home))
        return PathFinder.find_spec(fullname, _source_folders())

    def _whole(self) -> ModuleSpec | None:
        found = None if self.shadow else real_caffe()
        if found is None:
            return ModuleSpec(NAME, _Alias(HOME), is_package=True)
        advice = "netspec run --shadow-caffe uses netspec's"
        print(f"netspec: the Caffe that is installed at {found} is used; {advice}", file=sys.stderr)
        return None


class _Alias(importlib.abc.Loader):
    """Gives a module that has another name."""

    def __init__(self, home: str) -> None:
        self.home = home

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(self.home)
        self.spec = module.__spec__  # Python puts the alias's in its place
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self.spec


def _is_ours(module: ModuleType | None) -> bool:
    return module is not None and module.__name__ == HOME


def _source_folders() -> list[str]:
    """Return the folders of Caffe's sources on the path: forks keep modules of their own in them."""
    return [str(folder) for entry in sys.path if (folder := Path(entry) / NAME).joinpath("pycaffe.py").is_file()]
