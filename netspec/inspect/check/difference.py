"""Compares two messages of the same type field by field. An absent field counts as its default."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Declared

from netspec.errors import Where, printable
from netspec.proto.schema import Field, fields_of, given
from netspec.proto.source_map import Position
from netspec.proto.writer import scalar_text

#: Fields whose absence has a different meaning than their default.
PRESENCE_MATTERS = {
    ("caffe.BatchNormParameter", "use_global_stats"),
    ("caffe.LossParameter", "ignore_label"),
    ("caffe.LossParameter", "normalization"),
    ("caffe.LossParameter", "normalize"),
    ("caffe.ArgMaxParameter", "axis"),
    ("caffe.PReLUParameter", "filler"),
    ("caffe.ScaleParameter", "filler"),
}
#: Fields of windows: the two fields for each direction, and the default.
WINDOWS = {
    "kernel_size": ("kernel_h", "kernel_w", 0),
    "stride": ("stride_h", "stride_w", 1),
    "pad": ("pad_h", "pad_w", 0),
    "dilation": (None, None, 1),
}
OLD_NAMES = {"concat_dim": "axis", "slice_dim": "axis"}
ABSENT = "absent"


@dataclass(frozen=True)
class Difference:
    """One difference between two files, as a line of text.

    ``where`` is its position in the second file, or in the first if it has none there. ``other`` is the position in
    the first file, if there is one in both.
    """

    where: Where
    message: str
    other: Where | None = None

    def __str__(self) -> str:
        other = f" ({_short(self.other)})" if self.other else ""
        return printable(f"{self.where}: {self.message}{other}")


def _short(where: Where) -> str:
    return f"{where.file}:{where.line}:{where.column}" if where.line else where.file


Differences = Iterator[Difference]


def differences(first: Any, second: Any, here: Position, there: Position, ignored: Collection[str] = ()) -> Differences:
    """Yield the differences of ``second`` from ``first``; their positions are ``here`` and ``there``.

    The fields ``ignored`` are fields of the outermost message. Spellings with the same meaning are equal: ``kernel_h``
    and ``kernel_w`` for ``kernel_size``, one number for several equal ones, ``concat_dim`` for ``axis``.
    """
    done = set(ignored)
    fields = fields_of(first.DESCRIPTOR)
    if "kernel_size" in fields:
        for name, (high, wide, default) in WINDOWS.items():
            sides = [side for side in (high, wide) if side]
            if name in fields:
                done.update((name, *sides))
                one, other = (_window(message, fields, name, sides, default) for message in (first, second))
                if one != other:
                    named = [n for n in (name, *sides) if here.fields.get(n)] or [name]
                    yield Difference(
                        here.find(named[0]), f"{name} is {_times(other)}, was {_times(one)}", there.find(name)
                    )
    for old, name in OLD_NAMES.items():
        if old in fields:
            done.update((old, name))
            one, other = (fields[old if fields[old].present(m) else name].get(m) for m in (first, second))
            if one != other:
                yield Difference(here.find(name), f"{name} is {other}, was {one}", there.find(name))
    added = {f.descriptor.full_name: f for m in (first, second) for f in given(m) if f.descriptor.is_extension}
    for field in (*fields.values(), *added.values()):
        if field.name not in done:
            yield from _in_field(first, second, here, there, field)


def _in_field(first: Any, second: Any, here: Position, there: Position, field: Field) -> Differences:
    name = field.name
    positions = here.find(name), there.find(name)
    one, other = field.get(first), field.get(second)
    by_presence = (first.DESCRIPTOR.full_name, name) in PRESENCE_MATTERS
    if by_presence and field.present(first) != field.present(second):
        shown = [_value_text(field, m) if field.present(m) else ABSENT for m in (first, second)]
        yield Difference(positions[0], f"{name} is {shown[1]}, was {shown[0]}", positions[1])
    elif field.type == Declared.TYPE_MESSAGE and field.repeated:
        if len(one) != len(other):
            yield Difference(positions[0], f"{len(other)} {name} {{ }}, were {len(one)}", positions[1])
        for k, (a, b) in enumerate(zip(one, other, strict=False)):
            yield from differences(a, b, child(here, name, k), child(there, name, k))
    elif field.type == Declared.TYPE_MESSAGE:
        if field.present(first) or field.present(second):
            yield from differences(one, other, child(here, name), child(there, name))
    elif list(one) != list(other) if field.repeated else one != other and not (one != one and other != other):
        yield Difference(
            positions[0], f"{name} is {_value_text(field, second)}, was {_value_text(field, first)}", positions[1]
        )


def child(outer: Position, name: str, index: int = 0) -> Position:
    """Return the position of a message in a field, or that of the outer message if it is absent."""
    children = outer.fields.get(name, ())
    return children[index] if index < len(children) else Position(outer.where)


def _window(message: Any, fields: dict[str, Field], name: str, sides: list[str], default: int) -> tuple[int, ...]:
    if any(fields[side].present(message) for side in sides):
        return tuple(fields[side].get(message) for side in sides)
    values = fields[name].get(message)
    found = tuple(values) if fields[name].repeated else (values,)
    found = found or (default,)
    return found[:1] * 2 if len(set(found)) == 1 else found


def _times(sizes: tuple[int, ...]) -> str:
    return "x".join(map(str, sizes))


def _value_text(field: Field, message: Any) -> str:
    value = field.get(message)
    if field.type == Declared.TYPE_MESSAGE:
        return "given"
    values = value if field.repeated else [value]
    return " ".join(f'"{v}"' if isinstance(v, str) else scalar_text(field, v) for v in values) or ABSENT


def labeled(difference: Difference, layer: Any) -> Difference:
    """Return the difference with the layer's name and type added to its position."""
    where = Where(difference.where.file, difference.where.line, difference.where.column, layer.name, layer.type)
    return Difference(where, difference.message, difference.other)
