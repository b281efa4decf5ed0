"""Prints expressions as Python: names, numbers, and the lines of a statement.

A printed expression is a list of texts and of brackets' contents, which are lists of printed parts.
"""

from __future__ import annotations

import builtins
import inspect
import keyword
import operator
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from netspec.export.expression import TRAINING, Call, Expression, Submodule

WIDTH = 88  # ruff's and black's line length where nothing else is configured
_TAKEN = {"self", "x", "torch", "nn", "F", "math", "Path", "load_file", "load", "forward", "main", "expected"}
_TAKEN |= {name for name in dir(torch.nn.Module) if not name.startswith("__")} | {"training", "T_destination"}
_INFIX: dict[Any, tuple[str, int]] = {  # how tightly an operator binds
    operator.ne: (" != ", 1),
    operator.add: (" + ", 2),
    operator.sub: (" - ", 2),
    operator.mul: (" * ", 3),
    operator.truediv: (" / ", 3),
}
_SIGN, _ATOM = 4, 5


class Parts(list["Printed"]):
    """What stands in brackets, between commas."""


Printed = list["str | Parts"]


class Source:
    """The source of expressions, with these names of values, submodules, parameters and buffers."""

    def __init__(self, names: Mapping[Any, str]) -> None:
        self.names = {TRAINING: "self.training", **names}

    def of(self, value: Any, binds: int = 0) -> Printed:
        """Return an expression, or a number, as printed; in brackets where it binds less tightly than ``binds``."""
        printed, tightness = self._bound(value)
        return printed if tightness >= binds else ["(", Parts([printed]), ")"]

    def _bound(self, value: Any) -> tuple[Printed, int]:
        if isinstance(value, Call):
            return self._call(value)
        if isinstance(value, Expression):
            return [self.names[value]], _ATOM
        if isinstance(value, (tuple, list)) and value:
            opening, closing = "[]" if isinstance(value, list) else "()"
            lone = "," if len(value) == 1 and isinstance(value, tuple) else ""
            return [opening, Parts(self.of(part) for part in value), f"{lone}{closing}"], _ATOM
        return [number(value)], _ATOM if not isinstance(value, (int, float)) or value >= 0 else _SIGN

    def _call(self, it: Call) -> tuple[Printed, int]:
        function, args = it.function, it.args
        if function in _INFIX:
            sign, tightness = _INFIX[function]
            return [*self.of(args[0], tightness), sign, *self.of(args[1], tightness + 1)], tightness
        if function is operator.neg:
            return ["-", *self.of(args[0], _SIGN)], _SIGN
        if function is getattr:
            return [*self.of(args[0], _ATOM), f".{args[1]}"], _ATOM
        if function is operator.getitem:
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            inside = [part for each in index for part in (", ", *self._index(each))][1:]
            return [*self.of(args[0], _ATOM), "[", *inside, "]"], _ATOM
        if getattr(torch.Tensor, getattr(function, "__name__", ""), None) is function:
            head, args = [*self.of(args[0], _ATOM), f".{function.__name__}"], args[1:]
        else:
            head = [self.names[function] if function in self.names else name_of(function)]
        return [*head, *self.arguments(args, it.options)], _ATOM

    def _index(self, index: Any) -> Printed:
        if not isinstance(index, slice):
            return ["..."] if index is Ellipsis else self.of(index)
        ends = [[] if end is None else self.of(end) for end in (index.start, index.stop)]
        space = " " if any(isinstance(end, Call) for end in (index.start, index.stop)) else ""  # as ruff has it
        return [*ends[0], space if ends[0] else "", ":", space if ends[1] else "", *ends[1]]

    def arguments(self, args: Iterable[Any], options: Mapping[str, Any]) -> Printed:
        """Return the arguments of a call, in their brackets."""
        parts = Parts(self.of(value) for value in args)
        parts += [[f"{name}=", *self.of(value)] for name, value in options.items()]
        return ["(", parts, ")"] if parts else ["()"]

    def constructor(self, module: Submodule) -> Printed:
        """Return the call that makes a submodule."""
        return [f"nn.{module.cls.__name__}", *self.arguments(module.args, module.options)]


def name_of(function: Callable[..., Any]) -> str:
    """Return the name by which the source calls a function: of torch, or one that is copied into it."""
    name = function.__name__
    for library, prefix in ((F, "F."), (torch, "torch.")):
        if getattr(library, name, None) is function:
            return f"{prefix}{name}"
    return name


def copied(functions: Iterable[Any]) -> dict[str, Callable[..., Any]]:
    """Return those of the functions that the source must define, and those that they call, in order, by name."""
    found: dict[str, Callable[..., Any]] = {}
    for function in functions:
        if inspect.isfunction(function) and function.__module__.startswith("netspec."):
            called = [function.__globals__.get(name) for name in function.__code__.co_names]
            called += function.__defaults__ or ()
            found.update(copied(each for each in called if each is not function))
            found[function.__name__] = function
    return found


def source_of(function: Callable[..., Any]) -> str:
    """Return the source of a function that is copied."""
    return textwrap.dedent(inspect.getsource(function)).strip()


# Names: text from a file becomes only identifiers or quoted strings in the source


def legal(name: str, prefix: str = "layer_") -> str:
    """Return a legal Python name for a layer or a blob."""
    text = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or prefix.rstrip("_")
    return _free(prefix + text if text[0].isdigit() else text, "_")


def _free(identifier: str, ending: str) -> str:
    """Return an identifier, with a suffix if Python or the file already uses the name."""
    used = keyword.iskeyword(identifier) or identifier in _TAKEN or hasattr(builtins, identifier)
    return identifier + ending if used else identifier


def quoted(text: str) -> str:
    """Return a text as a literal in double quotes; without the quotes, it can also be part of a docstring."""
    return '"' + repr('"' + text)[2:-1].replace('"', '\\"') + '"'


def unique(name: str, taken: set[str]) -> str:
    """Return a name that is not in ``taken``, and add it there."""
    found, k = name, 2
    while found in taken:
        found, k = f"{name}_{k}", k + 1
    taken.add(found)
    return found


def class_name(text: str) -> str:
    """Return a class name made from the words of a text."""
    words = [word for word in re.split(r"[^0-9A-Za-z]+", text) if word]
    name = "".join(word[0].upper() + word[1:] for word in words) or "Net"
    return _free(f"Net{name}" if name[0].isdigit() else name, "Net")


def number(value: Any) -> str:
    """Return a number, a bool, a text or None as source; floats with as few digits as float32 allows."""
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, float):
        short = float(str(np.float32(value)))
        return repr(short) if np.isfinite(short) else f"{'-' * (short < 0)}torch.{abs(short)}"
    return repr(value)


# Lines


def text_of(printed: Iterable[str | Parts]) -> str:
    """Return what was printed as one line."""
    return "".join(part if isinstance(part, str) else ", ".join(map(text_of, part)) for part in printed)


def lay_out(printed: Printed, indent: int) -> list[str]:
    """Return a statement as lines. If it is longer than ``WIDTH``, each part of the widest brackets is a line."""
    space, text = " " * indent, text_of(printed)
    brackets = [i for i, part in enumerate(printed) if isinstance(part, Parts)]
    if indent + len(text) <= WIDTH or not brackets:
        return [space + text]
    widest = max(brackets, key=lambda i: len(text_of(printed[i : i + 1])))
    lines = [space + text_of(printed[:widest])]
    for part in printed[widest]:
        *before, last = lay_out(part, indent + 4)  # pyright: ignore[reportArgumentType]  a part of brackets
        lines += [*before, f"{last},"]
    return [*lines, space + text_of(printed[widest + 1 :])]
