"""The dialects of Caffe's forks: their messages and fields, as extensions of Caffe's messages.

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

Each dialect has a package of its own in the schema's pool, so forks may use the same names, and the classes of Caffe's
messages stay the same objects. Which dialect a field in a text belongs to is decided by the reader, for each text.
Numbers must be above those that Caffe itself uses in the message. A fork that uses one of these, as in
``interp_param = 143``, needs another number here; text files do not contain the numbers.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorProto
from google.protobuf.message import Message

from netspec.dialects.declarations import read_declarations
from netspec.errors import SpecError, Where
from netspec.proto.schema import (
    PACKAGE,
    SCOPE,
    Field,
    add_field,
    add_file,
    extension,
    extension_name,
    fields_of,
    given,
    pool,
)


@dataclass(frozen=True)
class Dialect:
    """What a fork adds. ``advice`` tells a user how to enable it, e.g. ``"add --plugin ssd"``.

    ``file`` is the source file, for errors, and ``module`` the module of its layers.
    """

    name: str
    source: str = ""
    layer_types: tuple[str, ...] = ()
    advice: str = ""
    file: str = ""
    module: str = ""

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

    def messages(self) -> set[str]:
        """The names of its own messages and enums."""
        return {each.name for each in (*self.declarations.message_type, *self.declarations.enum_type)}

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


def check(dialect: Dialect) -> None:
    """Raise SpecError if Caffe lacks a message that the dialect extends, or already has one of its fields or numbers.

    Raises SpecError also if the declarations cannot be read.
    """
    where = Where(dialect.declarations.name)
    for full_name, _ in dialect.numbers():
        try:
            pool.FindMessageTypeByName(full_name)
        except KeyError:
            raise SpecError(f'Caffe has no message "{full_name}" to extend', where) from None
    for full_name, field in dialect.fields():
        if field in fields_of(pool.FindMessageTypeByName(full_name)):
            raise SpecError(f'{full_name} already has a field "{field}"', where)
    for (full_name, number), field in dialect.numbers().items():
        message: Any = pool.FindMessageTypeByName(full_name)
        if not any(first <= number < last for first, last in message.extension_ranges):
            theirs = message.fields_by_number.get(number)
            owner = f'that of Caffe\'s "{theirs.name}"' if theirs else "kept for Caffe's own"
            advice = "files of text have no numbers, and the weights of a .caffemodel are read all the same"
            another = f'give "{field}" another, say {_free_number(full_name, dialect.numbers())}'
            raise SpecError(f"number {number} of {full_name} is {owner}; {another}: {advice}", where)


def check_beside(dialect: Dialect, others: Sequence[Dialect]) -> None:
    """Raise SpecError if one of the other dialects has a field, added values, a number or a layer type of this one."""
    where = Where(dialect.declarations.name)
    numbers = dialect.numbers()
    for other in others:
        for full_name, field in sorted(dialect.fields() & other.fields()):
            raise SpecError(f'{full_name} already has a field "{field}"', where)
        for full_name, field in sorted(dialect.values().keys() & other.values().keys()):
            raise SpecError(f'another added dialect adds values to "{field}" of {full_name}', where)
        for key in sorted(numbers.keys() & other.numbers().keys()):
            message = f'number {key[1]} of {key[0]} is used by "{other.numbers()[key]}" of dialect "{other.name}"'
            raise SpecError(f'{message}; give "{numbers[key]}" another number', where)
        for layer_type in sorted({*dialect.layer_types} & {*other.layer_types}):
            raise SpecError(f'layer type "{layer_type}" already exists, from {other.module}', where)


_lock = threading.RLock()
_declared: dict[str, Dialect] = {}  # by package, those that are in the pool
_taken: set[tuple[str, int]] = set()  # their numbers, by full name of the message


def declare(dialect: Dialect) -> None:
    """Add the messages and fields of a dialect to the schema's pool, once. No text is read in another way by that.

    A number that another dialect uses is replaced by a free one. Raises SpecError if the declarations do not fit.
    """
    file = dialect.declarations
    with _lock:
        if file.package in _declared:
            if _declared[file.package] != dialect:
                theirs = _declared[file.package].declarations.name
                raise SpecError(f'another dialect "{dialect.name}" was added, from {theirs}', Where(file.name))
            return
        scoped = FileDescriptorProto()
        scoped.CopyFrom(file)
        del scoped.extension[:]
        taken = set(_taken)
        scopes: dict[str, Any] = {}  # the new fields of each message are in a scope of their own, so names may repeat
        for declared in file.extension:
            message = declared.extendee.rpartition(".")[2]
            if message not in scopes:
                scopes[message] = scoped.message_type.add(name=SCOPE + message)
            own = scopes[message].extension.add()
            own.CopyFrom(declared)
            full_name = full_name_of(declared.extendee)
            if (full_name, own.number) in taken:
                own.number = _free_number(full_name, {*dialect.numbers(), *taken})
            taken.add((full_name, own.number))
        try:
            add_file(scoped)
        except TypeError as fault:
            raise SpecError(f"these declarations do not fit Caffe's schema: {fault}", Where(file.name)) from None
        for message, scope in scopes.items():
            for declared in scope.extension:
                add_field(declared, pool.FindExtensionByName(extension_name(file.package, message, declared.name)))
        _declared[file.package] = dialect
        _taken.update(taken)


def _free_number(message: str, taken: Iterable[tuple[str, int]]) -> int:
    """Return a number, from 2000, for another field of a message."""
    ranges = pool.FindMessageTypeByName(message).extension_ranges
    used = {number for name, number in taken if name == message}
    return next(n for first, last in ranges for n in range(max(first, 2000), last) if n not in used)


def field(dialect: Dialect, message: str, name: str) -> Field:
    """Return the field of a dialect that extends a message, given by its full name."""
    declare(dialect)
    return extension(extension_name(dialect.declarations.package, message.rpartition(".")[2], name))


def added_value(message: Message, name: str) -> str:
    """Return the name of the value of an enum field, if a dialect adds this value to the enum; else ""."""
    for field in given(message):
        if field.name == name and field.descriptor.is_extension:
            return field.descriptor.enum_type.values_by_number[field.get(message)].name
    return ""
