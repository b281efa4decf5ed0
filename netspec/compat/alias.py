"""A package that can also be imported under another name."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType


class Alias(importlib.abc.Loader):
    """A loader that returns the module with the name ``home``."""

    def __init__(self, home: str) -> None:
        self.home = home

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module. Python then replaces its spec by that of the alias."""
        module = importlib.import_module(self.home)
        self.spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Restore the module's own spec."""
        module.__spec__ = self.spec


class AliasFinder(importlib.abc.MetaPathFinder):
    """Finds the modules inside the package ``home`` when they are imported as modules inside ``name``."""

    def __init__(self, name: str, home: str) -> None:
        self.name, self.home = name, home

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the spec of such a module, or None for all others."""
        home = self.home + name.removeprefix(self.name)
        inside = name.startswith(f"{self.name}.") and importlib.util.find_spec(home)
        return ModuleSpec(name, Alias(home)) if inside else None


def alias(name: str, home: str) -> None:
    """Make ``name`` another name of the package ``home`` and of all modules inside it. Each is loaded once."""
    sys.modules[name] = importlib.import_module(home)
    sys.meta_path.insert(0, AliasFinder(name, home))
