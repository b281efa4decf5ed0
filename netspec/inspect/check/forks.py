"""Reports fields and layer types that neither Caffe nor a known dialect has, one line for each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from netspec.errors import Code, ForkFault, SpecError
from netspec.graph.options import BuildOptions
from netspec.layers import class_of, layer_class, unknown_type
from netspec.proto.forks import forks
from netspec.proto.schema import NetParameter
from netspec.proto.source_map import SourceMap

MOST_LINES = 8  # number of lines to list in an error


def unknown_types(net: NetParameter, source: SourceMap) -> Iterator[ForkFault]:
    """Yield a fault for each layer of a type that is not known."""
    meaning = forks().meaning(net, source.reporting_to(lambda fault: None), BuildOptions())
    for i, layer in enumerate(net.layer):
        if i not in meaning.classes and layer_class(layer.type) is None:
            where = source.at(i, "type", layer=layer.name, type=layer.type)
            message = unknown_type(layer.type)
            yield ForkFault(message, where, "layer", layer.type, forks().additions().types.get(layer.type, ()))


def python_layers(net: NetParameter, source: SourceMap) -> Iterator[SpecError]:
    """Yield a fault for each layer with Python code that may not run, for nets that cannot be built."""
    for i, layer in enumerate(net.layer):
        if fault := getattr(class_of(layer), "not_allowed", None):
            yield SpecError(fault, source.at(i, "type", layer=layer.name, type=layer.type))


def gathered(faults: Sequence[SpecError]) -> list[SpecError]:
    """Return the faults with those of the same unknown field or layer type joined, at the position of the first.

    An error in several nets of a solver counts once.
    """
    groups: dict[object, list[SpecError]] = {}
    for fault in {(fault.message, fault.where): fault for fault in faults}.values():
        file = fault.where.file if fault.where else ""
        key = (file, fault.message) if isinstance(fault, ForkFault) else fault
        groups.setdefault(key, []).append(fault)
    found = []
    for first, *more in groups.values():
        lines = list(dict.fromkeys(fault.where.line for fault in more if fault.where))
        named = ", ".join(map(str, lines[:MOST_LINES])) + (" and more" if len(lines) > MOST_LINES else "")
        also = f" (also in {'line' if len(lines) == 1 else 'lines'} {named})"
        found.append(SpecError(first.message + also, first.where) if more else first)
    return found


def others(faults: Sequence[SpecError], unknown: Sequence[SpecError]) -> list[SpecError]:
    """Return the faults without those that an unknown field or type in the same layer may have caused."""
    positions = {(fault.where.file, fault.where.layer) for fault in unknown if fault.where and fault.where.layer}
    own = [fault for fault in faults if fault.where and (fault.where.file, fault.where.layer) in positions]
    return [fault for fault in faults if fault not in own or fault.code is Code.UNKNOWN_BOTTOM]
