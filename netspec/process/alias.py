"""A package under another name too, the one that programs import."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType


class Alias(importlib.abc.Loader):
    """Gives a module that has another name."""

    def __init__(self, home: str) -> None:
        self.home = home

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module; Python puts the spec of the alias in the place of its own."""
        module = importlib.import_module(self.home)
        self.spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Give the module its own spec back."""
        module.__spec__ = self.spec


class AliasFinder(importlib.abc.MetaPathFinder):
    """Finds what is in a package under its other name."""

    def __init__(self, name: str, home: str) -> None:
        self.name, self.home = name, home

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the spec of such a module, None for all others."""
        home = self.home + name.removeprefix(self.name)
        inside = name.startswith(f"{self.name}.") and importlib.util.find_spec(home)
        return ModuleSpec(name, Alias(home)) if inside else None


def alias(name: str, home: str) -> None:
    """Let ``name``, with all that lies in it, be the package ``home``: the same modules, each loaded once."""
    sys.modules[name] = importlib.import_module(home)
    sys.meta_path.insert(0, AliasFinder(name, home))
