"""The dialects of Caffe's forks: their messages and fields, added to the schema while a dialect is active.

A dialect declares its additions in the language of caffe.proto: new messages as in the fork's own file, and new
fields of Caffe's messages in ``extend``::

    message NormalizeParameter {
      optional bool across_spatial = 1 [default = true];
    }
    extend LayerParameter {
      optional NormalizeParameter norm_param = 206;
    }

The text reader and writer then treat ``norm_param { ... }`` as a field of LayerParameter, and a layer reads it
with ``schema.value(self.param, "norm_param")``. Values for an enum of Caffe's are declared as a field that has the name
of Caffe's, of an enum that has the new ones only::

    enum PoolMethod { AVE_EXC_PAD = 3; }
    extend PoolingParameter {
      optional PoolMethod pool = 1036;
    }

``added_value(self.param.pooling_param, "pool")`` then is ``"AVE_EXC_PAD"``.

The classes of Caffe's messages stay the same objects; while no dialect is active, the schema is Caffe's. Numbers must
be above those that Caffe itself uses in the message. A fork that uses one of these (``interp_param = 143``) needs
another number here; text files do not contain the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorProto
from google.protobuf.message import Message

from netspec.dialects.declarations import read_declarations
from netspec.errors import SpecError, Where
from netspec.proto.schema import MORE, PACKAGE, add_file, added_fields, as_field, fields_of, pool


@dataclass(frozen=True)
class Dialect:
    """What a fork adds. ``advice`` tells a user how to enable it, e.g. ``"add --plugin ssd"``.

    ``file`` is the source file, for errors.
    """

    name: str
    source: str = ""
    layer_types: tuple[str, ...] = ()
    advice: str = ""
    file: str = ""

    @cached_property
    def declarations(self) -> FileDescriptorProto:
        """The additions as a descriptor, in a package of their own, so that forks may use the same names."""
        file = read_declarations(self.source, self.file or f"{self.name}.proto", f"{PACKAGE}.{self.name}")
        if "caffe.proto" not in file.dependency:
            file.dependency.append("caffe.proto")
        return file

    def fields(self) -> set[tuple[str, str]]:
        """The fields that it adds: full name of Caffe's message and name of the field."""
        return {(full_name, field) for (full_name, _), field in self.numbers().items()} - set(self.values())

    def values(self) -> dict[tuple[str, str], Sequence[str]]:
        """The values that it adds to Caffe's enums, by full name of the message and name of the field."""
        file = self.declarations
        enums = {enum.name: [value.name for value in enum.value] for enum in file.enum_type}
        added = {(full_name_of(f.extendee), f.name): enums[f.type_name] for f in file.extension if f.type_name in enums}
        return {key: names for key, names in added.items() if is_enum_of_caffe(*key)}

    def inner_fields(self) -> set[str]:
        """The names of the fields of its own messages."""
        return {field.name for declared in self.declarations.message_type for field in declared.field}

    def numbers(self) -> dict[tuple[str, int], str]:
        """The names of the fields that it adds, by full name of Caffe's message and number of the field."""
        added = self.declarations.extension
        return {(full_name_of(f.extendee), f.number): f.name for f in added}


def full_name_of(extendee: str) -> str:
    """Return the full name of a message of Caffe's, as ``extend`` names it."""
    return f"{PACKAGE}.{extendee.removeprefix(f'{PACKAGE}.')}"


def is_enum_of_caffe(message: str, field: str) -> bool:
    """Return whether a message of Caffe's (full name) has a field of an enum of this name."""
    try:
        found = pool.FindMessageTypeByName(message).fields_by_name.get(field)
    except KeyError:
        return False
    return found is not None and found.enum_type is not None


_known: dict[str, Dialect] = {}
_active: dict[str, Dialect] = {}


def announce(dialect: Dialect) -> None:
    """Make a dialect known, so that errors about its fields and layer types can name it.

    Raises SpecError if its declarations cannot be read, or extend a message that Caffe does not have.
    """
    for full_name, _ in dialect.numbers():
        try:
            pool.FindMessageTypeByName(full_name)
        except KeyError:
            raise SpecError(f'Caffe has no message "{full_name}" to extend', Where(dialect.declarations.name)) from None
    _known[dialect.name] = dialect


def activate(dialect: Dialect) -> None:
    """Announce a dialect and add its fields and messages to the schema. Does nothing if it is active.

    Raises SpecError like :func:`announce`, and if Caffe or another active dialect already has one of its fields or
    numbers, or its name.
    """
    if dialect.name in _active:
        if _active[dialect.name] != dialect:
            message = f'another dialect "{dialect.name}" is active, from {_active[dialect.name].declarations.name}'
            raise SpecError(message, Where(dialect.declarations.name))
        return
    announce(dialect)
    file = dialect.declarations
    for full_name, field in dialect.fields():
        if field in fields_of(pool.FindMessageTypeByName(full_name)):
            raise SpecError(f'{full_name} already has a field "{field}"', Where(file.name))
    for full_name, field in dialect.values():
        if field + MORE in fields_of(pool.FindMessageTypeByName(full_name)):
            message = f'another active dialect adds values to "{field}" of {full_name}'
            raise SpecError(message, Where(file.name))
    _check_numbers(dialect)
    try:
        pool.FindFileByName(file.name)
    except KeyError:
        _add(file)
    for declared in file.extension:
        descriptor: Any = pool.FindExtensionByName(f"{file.package}.{_scope(declared.extendee)}.{declared.name}")
        full_name = descriptor.containing_type.full_name
        added_fields.setdefault(full_name, {})[_key(dialect, full_name, declared.name)] = as_field(declared, descriptor)
    _active[dialect.name] = dialect


def _scope(extendee: str) -> str:
    return f"FieldsOf{extendee.rpartition('.')[2]}"


def _key(dialect: Dialect, full_name: str, field: str) -> str:
    return field + MORE if (full_name, field) in dialect.values() else field


def _check_numbers(dialect: Dialect) -> None:
    numbers = dialect.numbers()
    for (full_name, number), field in numbers.items():
        message: Any = pool.FindMessageTypeByName(full_name)
        ranges = message.extension_ranges
        if not any(first <= number < last for first, last in ranges):
            theirs = message.fields_by_number.get(number)
            owner = f'that of Caffe\'s "{theirs.name}"' if theirs else "kept for Caffe's own"
            used = {n for each in (dialect, *_active.values()) for name, n in each.numbers() if name == full_name}
            free = next(n for first, _ in ranges for n in range(max(first, 2000), 2**29) if n not in used)
            advice = "files of text have no numbers, and the weights of a .caffemodel are read all the same"
            fault = f'number {number} of {full_name} is {owner}; give "{field}" another, say {free}: {advice}'
            raise SpecError(fault, Where(dialect.declarations.name))
    for other in _active.values():
        for key in numbers.keys() & other.numbers().keys():
            message = f'number {key[1]} of {key[0]} is used by "{other.numbers()[key]}" of dialect "{other.name}"'
            raise SpecError(f'{message}; give "{numbers[key]}" another number', Where(dialect.declarations.name))


def _add(file: FileDescriptorProto) -> None:
    """Add a dialect's file to the pool. The new fields of each message have their own scope, so names may repeat."""
    scoped = FileDescriptorProto()
    scoped.CopyFrom(file)
    del scoped.extension[:]
    scopes: dict[str, Any] = {}
    for declared in file.extension:
        name = _scope(declared.extendee)
        if name not in scopes:
            scopes[name] = scoped.message_type.add(name=name)
        scopes[name].extension.append(declared)
    try:
        add_file(scoped)
    except TypeError as fault:
        raise SpecError(f"these declarations do not fit Caffe's schema: {fault}", Where(file.name)) from None


def deactivate(name: str) -> None:
    """Remove the fields of an active dialect from the schema."""
    dialect = _active.pop(name)
    for (full_name, _), field in dialect.numbers().items():
        del added_fields[full_name][_key(dialect, full_name, field)]


def known() -> list[Dialect]:
    """Return the dialects that were announced, by name."""
    return [_known[name] for name in sorted(_known)]


def active() -> list[str]:
    """Return the names of the active dialects."""
    return sorted(_active)


def active_dialects() -> tuple[Dialect, ...]:
    """Return the active dialects, in the order of their names."""
    return tuple(_active[name] for name in active())


def added_value(message: Message, name: str) -> str:
    """Return the name of the value of an enum field, if a dialect adds this value to the enum; else ""."""
    field = fields_of(message.DESCRIPTOR).get(name + MORE)
    if field is None or not field.present(message):
        return ""
    return field.descriptor.enum_type.values_by_number[field.get(message)].name


def dialects_with_field(message: str, field: str) -> tuple[str, ...]:
    """Return the known dialects that have a field of a message (full name; "" is any message)."""
    found = {d.name: d.fields() for d in _known.values()}
    return tuple(name for name, fields in found.items() if any(f == field and message in (m, "") for m, f in fields))


def dialects_with_inner_fields(dialects: Sequence[str], names: set[str]) -> tuple[str, ...]:
    """Return those of the dialects with messages that have the most of these fields; none if they have none."""
    found = {name: len(_known[name].inner_fields() & names) for name in dialects}
    most = max(found.values())
    return tuple(name for name, count in found.items() if count == most > 0)


def dialects_with_value(message: str, field: str, value: str) -> tuple[str, ...]:
    """Return the known dialects that add a value to an enum of Caffe's: that of a field of a message (full name)."""
    return tuple(d.name for d in _known.values() if value in d.values().get((message, field), ()))


def dialects_with_message(name: str) -> tuple[str, ...]:
    """Return the known dialects that have a message or an enum of their own."""
    files = {d.name: d.declarations for d in _known.values()}
    return tuple(d for d, file in files.items() if any(m.name == name for m in (*file.message_type, *file.enum_type)))


def dialects_with_type(layer_type: str) -> tuple[str, ...]:
    """Return the known dialects that have a layer type."""
    return tuple(d.name for d in _known.values() if layer_type in d.layer_types)


def advice_of(dialect: str) -> str:
    """Return how a user switches a known dialect on."""
    return _known[dialect].advice


def advice_for(name: str, dialects: tuple[str, ...]) -> str:
    """Return advice that names the known dialects with a field or layer type, or an empty string."""
    if not dialects:
        return ""
    names = " and ".join(f'"{d}"' for d in dialects)
    advice = f"; {advice_of(dialects[0])}" if advice_of(dialects[0]) else ""
    return (
        f'dialect{"s" if len(dialects) > 1 else ""} {names} {"have" if len(dialects) > 1 else "has"} "{name}"{advice}'
    )
