"""Rules that find probable mistakes in a legal file. Each rule has a name, so that a comment can disable it.

The comment ``# lint: ignore=NAME`` (or several names, separated by commas) applies to its line. If it is alone on its
line, it applies to the next one. On the first line of a layer it applies to the whole layer. On the first line of a
file it applies to findings about the whole file.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from netspec.errors import SpecError, Where, did_you_mean, printable
from netspec.proto.source_map import Position

# Kinds of input for rules, see Rule.
TEXT, PLAN, NET, SETTINGS, SOLVER = "text", "plan", "net", "settings", "solver"
UNKNOWN_RULE = "unknown-rule"

_COMMENT = re.compile(r"#\s*lint:\s*ignore\s*=\s*([\w-]+(?:\s*,\s*[\w-]+)*)")

Findings = Iterator[tuple[Where, str]]  # positions, and messages: what was found and what to do
F = TypeVar("F", bound=Callable[..., Findings])


@dataclass(frozen=True)
class Finding:
    """One line of advice: the rule, the position, what was found and what to do."""

    rule: str
    where: Where
    message: str

    def __str__(self) -> str:
        return printable(f"{self.where}: {self.message} [{self.rule}]")


@dataclass(frozen=True)
class Rule:
    """A rule: its name, its reason, and the function that applies it.

    ``looks_at`` is TEXT (the whole net, all phases), PLAN (the net of one phase, shapes unknown), NET (that net,
    built), SETTINGS (a solver alone) or SOLVER (a solver with its built nets, the training net first).
    """

    name: str
    reason: str
    looks_at: str
    find: Callable[..., Findings]


RULES: dict[str, Rule] = {}


def rule(name: str, looks_at: str) -> Callable[[F], F]:
    """Decorator that registers a generator of findings as a rule. Its docstring is the reason for the rule."""

    def add(find: F) -> F:
        assert name not in RULES, f"two rules are called {name}"
        RULES[name] = Rule(name, " ".join((find.__doc__ or "").split()), looks_at, find)
        return find

    return add


def findings(looks_at: str, *subject: object) -> list[Finding]:
    """Return the findings of all rules for ``looks_at``."""
    return [
        Finding(each.name, where, message)
        for each in RULES.values()
        if each.looks_at == looks_at
        for where, message in each.find(*subject)
    ]


def finding_lines(found: Iterable[Finding]) -> list[str]:
    """Return a line for each finding. Equal findings in one file become one, which lists the lines of all."""
    places: dict[tuple[str, str, str], list[Finding]] = {}
    for each in found:
        alike = places.setdefault((each.where.file, each.rule, each.message), [])
        if each not in alike:
            alike.append(each)
    lines = []
    for first, *others in places.values():
        numbers = ", ".join(str(each.where.line) for each in others if each.where.line)  # a binary file has no lines
        more = f" (also in {len(others)} more places{f', lines {numbers}' if numbers else ''})" if others else ""
        lines.append(f"{first}{more}")
    return lines


def findings_as_json(faults: Iterable[SpecError], found: Iterable[Finding]) -> dict[str, list[dict[str, Any]]]:
    """Return ``faults`` and ``warnings``, each a list of file, line, column, layer, type, message; and the rule.

    Lines and columns start at 1; 0 means unknown.
    """
    return {
        "faults": [{**_fields(fault.where or Where("")), "message": fault.message} for fault in faults],
        "warnings": [{**_fields(each.where), "message": each.message, "rule": each.rule} for each in found],
    }


def _fields(where: Where) -> dict[str, Any]:
    return {"file": where.file, "line": where.line, "column": where.column, "layer": where.layer, "type": where.type}


def not_ignored(found: Iterable[Finding], file: str, layers: Sequence[Position] = ()) -> list[Finding]:
    """Return the findings that no comment in the file disables, and findings about such comments.

    ``layers`` are the positions of the net's layers.
    """
    ignored = _ignored(file)
    starts = sorted(layer.where.line for layer in layers)
    kept = []
    for each in found:
        lines = {each.where.line or _first_line(file)}
        if each.where.layer and starts:
            lines.add(starts[max(0, bisect_right(starts, each.where.line) - 1)])
        if each.where.file != file or not any(each.rule in ignored.get(line, {}) for line in lines):
            kept.append(each)
    for names in ignored.values():
        for name, where in names.items():
            if name not in RULES:
                hint = did_you_mean(name, list(RULES)) or "; `netspec lint --rules` lists them"
                kept.append(Finding(UNKNOWN_RULE, where, f'there is no rule "{name}" to ignore{hint}'))
    return kept


def _ignored(file: str) -> dict[int, dict[str, Where]]:
    """Return the names of rules that are ignored by line, each with the position of its comment."""
    ignored: dict[int, dict[str, Where]] = {}
    waiting: dict[str, Where] = {}
    for number, line in enumerate(_lines(file), 1):
        text = line.partition("#")[0]
        found = _COMMENT.search(line)
        if found:
            where = Where(file, number, found.start() + 1)
            waiting.update({name.strip(): where for name in found[1].split(",")})
        if text.strip() and waiting:
            ignored[number], waiting = waiting, {}
    return ignored


def _first_line(file: str) -> int:
    lines = (number for number, line in enumerate(_lines(file), 1) if line.partition("#")[0].strip())
    return next(lines, 0)


def _lines(file: str) -> list[str]:
    try:
        return Path(file).read_text("utf-8", "replace").splitlines()
    except OSError:
        return []  # the text did not come from a file
