"""Repeated blocks of a program: the same statements on other values, with other weights, as a class of their own.

A block is a run of statements that reads one value from before it and of which one value is read after it. The repeated
run that saves the most statements becomes a block; its calls are statements, and the search begins anew. So a block may
contain small blocks, such as a convolution and what always follows it. It contains no large blocks.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from netspec.export.formats.source import MARK, Module, Program, Statement, class_name, legal, mark, unique

LEAST_SAVED = 6  # statements; fewer do not pay for a class
FEW_ARGUMENTS = 3
ARGUMENT = 0.5  # what each further argument costs in each place, in statements
WINDOW = "kernel_size"  # statements with other windows are not the same
OPEN = 0.6  # the worth of a run whose input others read too, as a part of a block does
SMALL = 3  # the most statements of a block that may be a part of another


@dataclass
class Argument:
    """A number of a block that is not the same in all its places."""

    name: str
    values: tuple[Any, ...]


@dataclass(eq=False)
class Block:
    """A class: its statements, with the values and modules of the first place where it stands.

    ``attributes`` are the modules' numbers by attribute; ``arguments`` name the numbers that differ, by the place of
    the number: (module, field) or the number of an expression.
    """

    name: str
    statements: list[Statement]
    input: int
    output: int
    attributes: dict[int, str]
    arguments: list[Argument]
    named: dict[tuple[int, str] | int, str]
    places: list[str]


@dataclass(frozen=True)
class _Run:
    start: int
    input: int
    output: int
    closed: bool


def find_blocks(program: Program, net: str) -> list[Block]:
    """Make classes of what is repeated, named otherwise than ``net``; their calls replace the program's statements."""
    blocks: list[Block] = []
    taken = {net, "Path"}
    while (found := _best(program)) is not None:
        blocks.append(_fold(program, *found, taken))
    return blocks


def _keys(program: Program) -> list[str]:
    """Return of each statement what it is, whatever it reads and however many channels there are."""

    def key(match: re.Match[str]) -> str:
        kind, number = match[1], int(match[2])
        if kind == "m":
            module = program.modules[number]
            return f"<{module.kind} {module.template} {module.numbers.get(WINDOW)}>"
        name, value = program.numbers[number] if kind == "n" else ("value", "")
        return f"<{name} {value}>" if name == WINDOW else f"<{name}>"

    return [MARK.sub(key, statement.expression) + f" {len(statement.targets)}" for statement in program.statements]


def _best(program: Program) -> tuple[int, list[_Run]] | None:
    """Return the length and the places of the run that saves most, or None."""
    statements = program.statements
    reads = Counter(v for statement in statements for v in statement.values())
    last_read: dict[int, int] = {}
    for i, statement in enumerate(statements):
        for v in statement.values():
            last_read[v] = i
    for v in program.outputs.values():
        last_read[v] = len(statements)
    groups = defaultdict(list)
    keys = _keys(program)
    for i, key in enumerate(keys):
        groups[key].append(i)
    candidates: list[tuple[float, int, list[_Run]]] = []
    length = 1
    current = [starts for starts in groups.values() if len(starts) > 1]
    while current:
        for starts in current:
            if (len(starts) - 1) * length < LEAST_SAVED:
                continue
            for runs in _alike(program, starts, length, reads, last_read).values():
                candidates.append(((len(runs) - 1) * length * (1 if runs[0].closed else OPEN), length, runs))
        length += 1
        longer = defaultdict(list)
        for k, starts in enumerate(current):
            for start in starts:
                if start + length <= len(keys):
                    longer[k, keys[start + length - 1]].append(start)
        current = [starts for starts in longer.values() if len(starts) > 1]
    best: tuple[float, int, list[_Run]] | None = None
    for saved, length, runs in sorted(candidates, key=lambda candidate: -candidate[0]):
        if saved <= (best[0] if best else LEAST_SAVED - 1):
            break
        extra = max(0, len(_columns(program, runs, length)) - FEW_ARGUMENTS)
        worth = saved - len(runs) * extra * ARGUMENT
        if worth >= LEAST_SAVED and (best is None or worth > best[0]):
            best = (worth, length, runs)
    return None if best is None else (best[1], best[2])


def _alike(
    program: Program, starts: list[int], length: int, reads: Counter[int], last_read: dict[int, int]
) -> dict[tuple[Any, ...], list[_Run]]:
    """Return the runs that are blocks, by how their values flow; those of one kind do not overlap."""
    found: dict[tuple[Any, ...], list[_Run]] = defaultdict(list)
    for start in starts:
        end = start + length
        run = program.statements[start:end]
        used = [program.modules[m] for statement in run for m in statement.modules()]
        if len(used) < 2 or any(module.statements > SMALL for module in used):
            return {}
        inputs: dict[int, int] = {}
        local: dict[int, int] = {}
        flow: list[Any] = []
        modules: dict[int, int] = {}
        for statement in run:
            for v in statement.values():
                flow.append(local[v] if v in local else -1 - inputs.setdefault(v, len(inputs)))
            for m in statement.modules():
                flow.append(f"m{modules.setdefault(m, len(modules))}")
            for v in statement.targets:
                local[v] = len(local)
        outputs = [v for v in local if last_read.get(v, -1) >= end]
        if len(outputs) != 1 or len(inputs) != 1 or _is_changed_in_place(program, outputs[0], end):
            continue
        runs = found[(*flow, local[outputs[0]])]
        if not runs or runs[-1].start + length <= start:
            (value,) = inputs
            inside = sum(statement.values().count(value) for statement in run)
            runs.append(_Run(start, value, outputs[0], inside == reads[value]))
    return {flow: runs for flow, runs in found.items() if len(runs) > 1}


def _is_changed_in_place(program: Program, value: int, end: int) -> bool:
    """Say whether what follows writes over a value, as an activation does that belongs to it."""
    if end >= len(program.statements):
        return False
    after = program.statements[end]
    return value in after.values() and program.names[after.targets[0]] == program.names[value]


def _fold(program: Program, length: int, runs: list[_Run], taken: set[str]) -> Block:
    """Replace the runs by calls of a new block."""
    first = program.statements[runs[0].start : runs[0].start + length]
    places = [_place_name(program, run, length) for run in runs]
    block = Block(
        name=unique(_block_name(program, first, places, taken), taken),
        statements=first,
        input=runs[0].input,
        output=runs[0].output,
        attributes={},
        arguments=[],
        named={},
        places=places,
    )
    modules = [_modules(program.statements[run.start : run.start + length]) for run in runs]
    block.attributes = _attributes(program, modules, places)
    values = _name_arguments(program, block, runs, length)
    made: dict[tuple[int, ...], int] = {}  # modules of a place -> the block's module
    for k, run in reversed(list(enumerate(runs))):
        own = tuple(modules[k])
        if own not in made:
            parts = {block.attributes[m]: program.modules[n] for m, n in zip(modules[0], own, strict=True)}
            numbers = {name: values[name][k] for name in values}
            fields = ", ".join(
                f"{{{name}}}" if len(numbers) <= 3 or i == 0 else f"{name}={{{name}}}" for i, name in enumerate(numbers)
            )
            program.modules.append(
                Module(places[k], f"{block.name}({fields})", numbers, {}, parts=parts, statements=length)
            )
            made[own] = len(program.modules) - 1
        expression = mark("m", made[own]) + f"({mark('v', run.input)})"
        program.statements[run.start : run.start + length] = [Statement((run.output,), expression, places[k])]
    for place, own in reversed(list(zip(places, modules, strict=True))):
        program.modules[made[tuple(own)]].layer = place  # where it stands twice, the first place
    return block


def _modules(statements: list[Statement]) -> list[int]:
    return list(dict.fromkeys(m for statement in statements for m in statement.modules()))


def _place_name(program: Program, run: _Run, length: int) -> str:
    """Return what a block is called where it stands: what its layers' names have in common, or the blob it makes."""
    statements = program.statements[run.start : run.start + length]
    layers = [program.modules[m].layer for m in _modules(statements)]
    common = _common(layers).rstrip("/_-. ")
    whole = all(re.match(re.escape(common) + r"(\W|_|$)", layer) for layer in layers)
    return common if len(common) > 2 and whole else program.names[run.output]


def _block_name(program: Program, statements: list[Statement], places: list[str], taken: set[str]) -> str:
    """Return a name for a class: what it is made of if that is little, or else what its places have in common."""
    calls = []
    for statement in statements:
        modules = statement.modules()
        calls.append(program.modules[modules[0]].template if modules else statement.expression)
    words = [re.match(r"[\w.]+", call) for call in calls]
    if len(statements) <= SMALL and all(words):
        kinds = [re.sub(r"\d?d$", "", word[0].split(".")[-1]) for word in words if word]
        name = "".join(
            {"relu": "ReLU", "relu6": "ReLU6", "BatchNorm": "BN"}.get(kind, class_name(kind)) for kind in kinds
        )
        return name if name not in taken else class_name(places[0]) + name
    common = _common([re.split(r"\d|[_/\-. ]", place)[0] for place in places])
    name = (class_name(common) if len(common) > 1 else "") + "Block"
    return name if name not in taken else class_name(places[0]) + "Block"


def _common(words: Sequence[str]) -> str:
    """Return the beginning that words have in common."""
    first, last = min(words), max(words)
    return next((first[:i] for i, letter in enumerate(first) if last[i : i + 1] != letter), first)


def _attributes(program: Program, modules: list[list[int]], places: list[str]) -> dict[int, str]:
    """Return attributes for the first place's modules: of the layers' names what all places have in common."""
    names = []
    for column in zip(*modules, strict=True):
        tokens = [re.split(r"[^0-9A-Za-z]+", program.modules[m].layer) for m in column]
        kept = []
        if len({len(each) for each in tokens}) == 1:
            for words in zip(*tokens, strict=True):
                kept.append(words[0] if len(set(words)) == 1 else _common(words).rstrip("0123456789"))
        names.append([word for word in kept if word])
    while len(names) > 1 and all(len(words) > 1 for words in names) and len({words[0] for words in names}) == 1:
        names = [words[1:] for words in names]
    stem = _common([re.split(r"\d|[_/\-. ]", place)[0] for place in places])
    names = [words[1:] if len(words) > 1 and words[0] == stem else words for words in names]
    taken: set[str] = set()
    found = {}
    for m, words in zip(modules[0], names, strict=True):
        kind = re.sub(r"\d?d$", "", re.split(r"\W", program.modules[m].template.removeprefix("nn."))[0]).lower()
        kind = {"batchnorm": "bn"}.get(kind, kind)
        text = "_".join(words)
        found[m] = unique(legal(text or kind, f"{kind}_"), taken)
    return found


def _name_arguments(program: Program, block: Block, runs: list[_Run], length: int) -> dict[str, tuple[Any, ...]]:
    """Name the numbers that are not the same in all places; return the arguments, name -> value in each place."""
    known: dict[tuple[Any, ...], str] = {}
    taken = {"x", "y"}
    for values, keys in _columns(program, runs, length).items():
        if isinstance(keys[0], tuple):
            attribute, name = block.attributes[keys[0][0]], keys[0][1]
        else:
            attribute, name = "", program.numbers[keys[0]][0]
        if name == "in_channels" and not known:
            wanted = "in_channels"
        elif name in ("out_channels", "channels"):
            wanted = f"{attribute}_channels"
        else:
            wanted = f"{attribute}_{name}" if attribute else name
        known[values] = unique(wanted, taken)
        block.named.update(dict.fromkeys(keys, known[values]))
    return {name: values for values, name in known.items()}


def _columns(program: Program, runs: list[_Run], length: int) -> dict[tuple[Any, ...], list[tuple[int, str] | int]]:
    """Return the numbers that are not the same in all places: their values by place, and where the first has them.

    That is (module, field), or the number of an expression.
    """
    columns: dict[tuple[Any, ...], list[tuple[int, str] | int]] = {}
    parts = [program.statements[run.start : run.start + length] for run in runs]
    for column in zip(*map(_modules, parts), strict=True):
        for name in program.modules[column[0]].numbers:
            values = tuple(program.modules[m].numbers[name] for m in column)
            columns.setdefault(values, []).append((column[0], name))
    for column in zip(*([n for statement in part for n in statement.numbers()] for part in parts), strict=True):
        values = tuple(program.numbers[n][1] for n in column)
        columns.setdefault(values, []).append(column[0])
    return {values: keys for values, keys in columns.items() if any(value != values[0] for value in values)}
