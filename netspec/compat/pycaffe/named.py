"""Ordered dictionaries by name."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, TypeVar

from netspec.errors import did_you_mean

T = TypeVar("T")


class Named(OrderedDict[str, T]):
    """An OrderedDict; the error for an unknown name lists the known ones."""

    def __init__(self, what: str = "name", items: Any = ()) -> None:
        self.what = what
        super().__init__(items)
        self._is_whole = True

    def __setitem__(self, name: str, value: T) -> None:
        if getattr(self, "_is_whole", False):
            raise TypeError(f'the {self.what} "{name}" cannot be replaced; write to it: .data[...] = array')
        super().__setitem__(name, value)

    def __missing__(self, name: str) -> T:
        known = ", ".join(self) or "none"
        hint = did_you_mean(str(name), list(self)) or ";"
        raise KeyError(f'no {self.what} "{name}" in this net{hint} it has: {known}')

    def __reduce__(self) -> Any:
        return Named, (self.what, list(self.items()))
