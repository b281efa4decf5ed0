"""Lets ``import caffe`` and its submodules find :mod:`netspec.pycaffe`, unless there is a real Caffe.

A real Caffe is any package or module ``caffe`` on ``sys.path``, except Caffe's sources without the compiled part.
Scripts put these on the path (``sys.path.insert(0, caffe_root + "python")``), but they cannot be imported.
"""

from __future__ import annotations

import importlib.abc
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from netspec.compat.alias import Alias

NAME = "caffe"
HOME = "netspec.compat.pycaffe"
MARK = "# netspec as caffe"  # the first line of what `netspec install-caffe` writes


def install(shadow: bool = False) -> None:
    """Let ``import caffe`` find netspec.pycaffe from now on; with ``shadow`` even if there is a real Caffe."""
    uninstall()
    sys.meta_path.insert(0, CaffeFinder(shadow))


def uninstall() -> None:
    """Undo :func:`install`. Modules that were imported stay."""
    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, CaffeFinder)]


def real_caffe() -> str | None:
    """Return the path of the real Caffe that Python finds now, or None."""
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
    """Finds ``caffe`` and its submodules."""

    def __init__(self, shadow: bool) -> None:
        self.shadow = shadow

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """Return the spec of netspec's module, or of another one in Caffe's sources, or None: Python searches on."""
        if fullname == NAME:
            return self._whole()
        parent, _, leaf = fullname.rpartition(".")
        ours = getattr(sys.modules.get(parent), "__name__", "")
        if ours != HOME and not ours.startswith(f"{HOME}."):
            return None
        home = f"{ours}.{leaf}"
        if home in sys.modules or PathFinder.find_spec(home, path):
            return None if fullname == home else ModuleSpec(fullname, Alias(home))
        if fullname != home:
            return self._in_a_tree(fullname)
        outside = NAME + home.removeprefix(HOME)  # `from caffe import x` imports by our own name
        return ModuleSpec(fullname, Alias(outside)) if self._search(outside) else None

    def _in_a_tree(self, fullname: str) -> ModuleSpec:
        spec = self._search(fullname)
        if spec is None:
            advice = 'to import Python files of a Caffe tree, add its folder "python" to sys.path or PYTHONPATH'
            raise ModuleNotFoundError(f"No module named '{fullname}'; {advice}", name=fullname)
        return spec

    def _search(self, fullname: str) -> ModuleSpec | None:
        """Return the spec of a module in Caffe's sources on the path, from the other finders, or None."""
        inside = Path(*fullname.split(".")[:-1])
        trees = [Path(entry) for entry in sys.path if (Path(entry) / NAME / "pycaffe.py").is_file()]
        folders = [str(tree / inside) for tree in trees]
        others = (finder for finder in sys.meta_path if finder is not self)
        found = (finder.find_spec(fullname, folders) for finder in others if hasattr(finder, "find_spec"))
        return next((spec for spec in found if spec is not None), None)

    def _whole(self) -> ModuleSpec | None:
        found = None if self.shadow else real_caffe()
        if found is None:
            return ModuleSpec(NAME, Alias(HOME), is_package=True)
        advice = "to use netspec instead, run netspec run --shadow-caffe"
        print(f"netspec: using the Caffe installed at {found}; {advice}", file=sys.stderr)
        return None
