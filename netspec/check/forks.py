"""What a file has of Caffe's forks, gathered into few lines: one for each dialect, one for each field of no dialect."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from netspec.errors import ForkFault, SpecError
from netspec.layers import layer_class, unknown_type
from netspec.proto.dialect.registry import advice_of, dialects_with_type
from netspec.proto.schema import NetParameter
from netspec.proto.source_map import SourceMap

MOST_LINES = 8  # line numbers that a fault names


def unknown_types(net: NetParameter, source: SourceMap) -> Iterator[ForkFault]:
    """Yield a fault for each layer of a type that is not known."""
    for i, layer in enumerate(net.layer):
        if layer_class(layer.type) is None:
            where = source.at(i, "type", layer=layer.name, type=layer.type)
            message = unknown_type(layer.type)
            yield ForkFault(message, where, "layer", layer.type, dialects_with_type(layer.type))


def gathered(faults: Sequence[SpecError]) -> list[SpecError]:
    """Return the faults with those about forks gathered, each in the place of the first of its kind.

    A fault is counted once, though several nets of a solver have it. A field that several dialects have counts for the
    dialect of which the file has most.
    """
    sizes = Counter(name for fault in faults if isinstance(fault, ForkFault) for name in fault.dialects)
    groups: dict[object, list[ForkFault]] = {}
    result: list[SpecError | list[ForkFault]] = []
    for fault in {(fault.message, fault.where): fault for fault in faults}.values():
        if not isinstance(fault, ForkFault):
            result.append(fault)
            continue
        file = fault.where.file if fault.where else ""
        dialect = max(fault.dialects, key=lambda name: sizes[name], default="")
        key = (file, "dialect", dialect) if dialect else (file, fault.message)
        if key not in groups:
            groups[key] = []
            result.append(groups[key])
        groups[key].append(fault)
    return [fault if isinstance(fault, SpecError) else _as_one(fault, sizes) for fault in result]


def _as_one(faults: list[ForkFault], sizes: Counter[str]) -> SpecError:
    first = faults[0]
    if len(faults) == 1:
        return first
    if not first.dialects:
        return SpecError(f"{first.message} ({_also_in(faults[1:])})", first.where)
    dialect = max(first.dialects, key=lambda name: sizes[name])
    fields, layers = ([fault for fault in faults if fault.what == what] for what in ("field", "layer"))
    parts = [_count(part, what) for part, what in ((fields, "field"), (layers, "layer")) if part]
    message = f'{" and ".join(parts)} of dialect "{dialect}"; {advice_of(dialect)}'
    return SpecError(message, first.where and replace(first.where, layer="", type=""))


def _count(faults: list[ForkFault], what: str) -> str:
    names = Counter(fault.name for fault in faults)
    told = ", ".join(name if times == 1 else f"{name} {times} times" for name, times in names.items())
    return f"{len(faults)} {what}{'s' if len(faults) > 1 else ''} ({told})"


def _also_in(faults: Iterable[ForkFault]) -> str:
    lines = list(dict.fromkeys(fault.where.line for fault in faults if fault.where))
    named = ", ".join(map(str, lines[:MOST_LINES])) + (" and more" if len(lines) > MOST_LINES else "")
    return f"also in {'line' if len(lines) == 1 else 'lines'} {named}"
