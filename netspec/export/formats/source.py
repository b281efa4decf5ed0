"""A PyTorch program while it is written: statements, the modules they call, and the text of both.

An expression is text in which marks stand for values and modules: names are given when all is known.
"""

from __future__ import annotations

import builtins
import keyword
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

WIDTH = 88  # ruff's and black's line length where nothing else is configured
_STRING = re.compile(r'"(?:[^"\\]|\\.)*"')
MARK = re.compile("\x02([vm])(\\d+)\x03")  # a value, a module
_TAKEN = {"self", "x", "torch", "nn", "F", "math", "Path", "load_file", "load", "forward", "main"}
_TAKEN |= {name for name in dir(torch.nn.Module) if not name.startswith("__")} | {"training", "T_destination"}


def mark(kind: str, number: int) -> str:
    """Return the mark of a value (v) or a module (m)."""
    return f"\x02{kind}{number}\x03"


@dataclass(eq=False)
class Module:
    """A submodule, or a parameter or buffer of the module itself: its constructor's call, and its tensors by name.

    ``numbers`` are the values of the fields of the template; those that are the ``usual`` ones are left out.
    """

    layer: str
    template: str
    numbers: dict[str, Any]
    state: dict[str, torch.Tensor]
    kind: str = "module"  # or "buffer"
    usual: dict[str, Any] = field(default_factory=dict)

    def constructor(self) -> str:
        """Return the constructor's call."""
        template = self.template
        for name, value in self.usual.items():
            if self.numbers[name] == value:
                template = template.replace(f", {name}={{{name}}}", "")
        return template.format(**{name: number(value) for name, value in self.numbers.items()})

    def tensors(self, prefix: str) -> dict[str, torch.Tensor]:
        """Return all tensors as they are named in a state_dict, for the attribute ``prefix``."""
        return {f"{prefix}.{name}" if name else prefix: tensor for name, tensor in self.state.items()}


@dataclass(eq=False)
class Statement:
    """Values from an expression, of a layer; ``keeps_shape``: its value has the shape of the first that it reads."""

    targets: tuple[int, ...]
    expression: str
    layer: str
    keeps_shape: bool = False

    def values(self) -> list[int]:
        """Return the values that it reads, in order, each as often as it does."""
        return [int(number) for kind, number in MARK.findall(self.expression) if kind == "v"]

    def modules(self) -> list[int]:
        """Return the modules that it uses, in order."""
        return [int(number) for kind, number in MARK.findall(self.expression) if kind == "m"]


@dataclass
class Program:
    """A whole module: what it takes and gives, and how it computes it.

    ``names`` are the blobs' names of values; ``inputs`` and ``outputs`` are values; ``modules`` are what
    marks stand for; ``functions`` are copied as they are.
    """

    statements: list[Statement] = field(default_factory=list)
    modules: list[Module] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    inputs: list[int] = field(default_factory=list)
    outputs: dict[str, int] = field(default_factory=dict)
    functions: dict[str, Callable[..., Any]] = field(default_factory=dict)

    def attributes(self) -> dict[int, str]:
        """Return the attribute of each module that the net's class has, in the order in which they are used."""
        taken: set[str] = set()
        used = dict.fromkeys(m for statement in self.statements for m in statement.modules())
        return {m: unique(legal(self.modules[m].layer), taken) for m in used}


# Names: no text of a file enters source but as an identifier or quoted


def legal(name: str, prefix: str = "layer_") -> str:
    """Return a Python name made of a layer's or a blob's."""
    text = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or prefix.rstrip("_")
    return _free(prefix + text if text[0].isdigit() else text, "_")


def _free(identifier: str, ending: str) -> str:
    """Return an identifier, with the ending where Python or the file itself uses it."""
    used = keyword.iskeyword(identifier) or identifier in _TAKEN or hasattr(builtins, identifier)
    return identifier + ending if used else identifier


def quoted(text: str) -> str:
    """Return a text as a literal in double quotes; without its quotes it can stand in a docstring too."""
    return '"' + repr('"' + text)[2:-1].replace('"', '\\"') + '"'


def unique(name: str, taken: set[str]) -> str:
    """Return a name that is not in ``taken``, and add it there."""
    found, k = name, 2
    while found in taken:
        found, k = f"{name}_{k}", k + 1
    taken.add(found)
    return found


def class_name(text: str) -> str:
    """Return the name of a class made of words."""
    words = [word for word in re.split(r"[^0-9A-Za-z]+", text) if word]
    name = "".join(word[0].upper() + word[1:] for word in words) or "Net"
    return _free(f"Net{name}" if name[0].isdigit() else name, "Net")


def number(value: Any) -> str:
    """Return a number, a bool or a tuple of them as a person writes it; floats as short as float32 allows.

    A text, which is the name of a free size, is quoted.
    """
    if isinstance(value, (tuple, list)):
        inner = ", ".join(number(v) for v in value)
        return f"[{inner}]" if isinstance(value, list) else f"({inner},)" if len(value) == 1 else f"({inner})"
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            return "torch.nan" if math.isnan(value) else "torch.inf" if value > 0 else "-torch.inf"
        text = (
            np.format_float_positional(np.float32(value), trim="-")
            if 1e-4 <= abs(value) < 1e6
            else str(np.float32(value))
        )
        if value == 0 or (float(text) == int(float(text)) and "e" not in text):
            return f"{int(float(text))}.0"
        mantissa, _, exponent = text.partition("e")
        return f"{mantissa}e{int(exponent)}" if exponent else text
    return repr(value)


# Layout, as ruff's formatter has it


def lay_out(statement: str, indent: int) -> list[str]:
    """Return a statement in lines of at most ``WIDTH``, broken as ruff's formatter breaks it."""
    space = " " * indent
    if indent + len(statement) <= WIDTH:
        return [space + statement]
    brackets = _outermost_brackets(statement)
    if not brackets:
        return [space + statement]
    opening, closing = max(brackets, key=lambda pair: pair[1] - pair[0])
    body = statement[opening + 1 : closing]
    head, tail = statement[: opening + 1], statement[closing:]
    parts = _split(body)
    inner = " " * (indent + 4)
    lines = [space + head]
    if indent + 4 + len(body) <= WIDTH and not body.endswith(","):
        lines.append(inner + body)
    else:
        called = statement[opening] == "[" or (opening > 0 and statement[opening - 1] not in " ([{")
        comma = "" if len(parts) == 1 and (" for " in parts[0] or not called) else ","
        for part in parts:
            broken = lay_out(part, indent + 4)
            lines += [*broken[:-1], broken[-1] + comma]
    return [*lines, space + tail]


def _outside_strings(text: str) -> Iterator[tuple[int, str]]:
    """Yield the characters that are in no quoted text, and where they are."""
    end = 0
    for match in _STRING.finditer(text):
        yield from enumerate(text[end : match.start()], end)
        end = match.end()
    yield from enumerate(text[end:], end)


def _outermost_brackets(text: str) -> list[tuple[int, int]]:
    """Return where the brackets that are in no others open and close."""
    found, depth, opening = [], 0, 0
    for i, character in _outside_strings(text):
        if character in "([{":
            opening = i if depth == 0 else opening
            depth += 1
        elif character in ")]}":
            depth -= 1
            if depth == 0:
                found.append((opening, i))
    return found


def _split(text: str) -> list[str]:
    """Return the parts of an argument list."""
    parts, depth, start = [], 0, 0
    for i, character in _outside_strings(text):
        depth += (character in "([{") - (character in ")]}")
        if character == "," and depth == 0:
            parts.append(text[start:i].strip())
            start = i + 1
    last = text[start:].strip()
    return [*parts, last] if last else parts


def is_atom(expression: str) -> bool:
    """Say whether an expression binds as a name or a call does: no operator outside brackets."""
    depth = 0
    for character in MARK.sub("v", expression):
        if character in "([{":
            depth += 1
        elif character in ")]}":
            depth -= 1
        elif depth == 0 and character in " +-*/":
            return False
    return True


def substitute(expression: str, replace: Callable[[str, int], str]) -> str:
    """Return an expression with each mark replaced; ``replace`` gets its kind and number.

    What is put in gets brackets where it stands beside an operator.
    """
    parts, end = [], 0
    for match in MARK.finditer(expression):
        text = replace(match[1], int(match[2]))
        before, after = expression[: match.start()], expression[match.end() :]
        alone = (not before or before.endswith(("(", "[", ", "))) and (not after or after.startswith((")", "]", ",")))
        parts += [expression[end : match.start()], text if alone or is_atom(text) else f"({text})"]
        end = match.end()
    return "".join([*parts, expression[end:]])


def joined(words: Sequence[str]) -> str:
    """Return words as an English list."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
