"""The dialects of Caffe's forks: their messages and fields, as extensions of Caffe's messages.

A dialect declares its additions in the language of caffe.proto: new messages as in the fork's own file, and new
fields of Caffe's messages in ``extend``. The text reader and writer then treat ``norm_param { ... }`` as a field of
LayerParameter, and a layer reads it with ``schema.value(self.param, "norm_param")``. Values for an enum of Caffe's are
declared as a field that has the name of Caffe's, of an enum that has the new ones only::

    enum PoolMethod { AVE_EXC_PAD = 3; }
    extend PoolingParameter {
      optional PoolMethod pool = 1036;
    }

``added_value(self.param.pooling_param, "pool")`` then is ``"AVE_EXC_PAD"``.

Each dialect has a package of its own in the schema's pool, so forks may use the same names, and the classes of Caffe's
messages stay the same objects. Which dialect a field in a text belongs to is decided by the reader, for each text.
Files of text have no numbers: a number that Caffe or another dialect uses is replaced by a free one.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
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
    """What a fork adds. ``file`` is the source file, for errors, and ``module`` the module of its layers."""

    name: str
    source: str = ""
    layer_types: tuple[str, ...] = ()
    file: str = ""
    module: str = ""

    @cached_property
    def declarations(self) -> FileDescriptorProto:
        """The additions as a descriptor, in a package of their own, so that forks may use the same names.

        Raises SpecError if they cannot be read, if Caffe lacks a message that they extend, or has one of the fields.
        """
        file = read_declarations(self.source, self.file or f"{self.name}.proto", f"{PACKAGE}.{self.name}")
        enums = {enum.name for enum in file.enum_type}
        for field in file.extension:
            field.extendee = f"{PACKAGE}.{field.extendee.removeprefix(f'{PACKAGE}.')}"
            try:
                message: Any = pool.FindMessageTypeByName(field.extendee)
            except KeyError:
                raise SpecError(f'Caffe has no message "{field.extendee}" to extend', Where(file.name)) from None
            theirs = message.fields_by_name.get(field.name)
            if theirs and not (theirs.enum_type and field.type_name in enums):
                raise SpecError(f'{field.extendee} already has a field "{field.name}"', Where(file.name))
        return file

    def fields(self) -> set[tuple[str, str]]:
        """The fields that it adds: full name of Caffe's message and name of the field."""
        return {(field.extendee, field.name) for field in self.declarations.extension} - set(self.values())

    def values(self) -> dict[tuple[str, str], Sequence[str]]:
        """The values that it adds to Caffe's enums, by full name of the message and name of the field."""
        enums = {enum.name: [value.name for value in enum.value] for enum in self.declarations.enum_type}
        added = self.declarations.extension
        return {
            (field.extendee, field.name): enums[field.type_name]
            for field in added
            if field.name in fields_of(pool.FindMessageTypeByName(field.extendee))
        }

    def messages(self) -> set[str]:
        """The names of its own messages and enums."""
        return {each.name for each in (*self.declarations.message_type, *self.declarations.enum_type)}


_lock = threading.RLock()
_declared: dict[str, tuple[Dialect, FileDescriptorProto]] = {}  # those in the pool, by name, with their declarations
_taken: set[tuple[str, int]] = set()  # their numbers, by full name of the message


def declare(dialect: Dialect) -> FileDescriptorProto:
    """Add the messages and fields of a dialect to the schema's pool, once, and return them as they are there.

    The new fields of a message are declared inside one of their own. No text is read in another way by that. Raises
    SpecError if the declarations do not fit.
    """
    file = dialect.declarations
    with _lock:
        if dialect.name in _declared:
            known, scoped = _declared[dialect.name]
            if known != dialect:
                message = f'another dialect "{dialect.name}" was added, from {known.declarations.name}'
                raise SpecError(message, Where(file.name))
            return scoped
        scoped, scopes, taken = FileDescriptorProto(), dict[str, Any](), set(_taken)
        scoped.CopyFrom(file)
        del scoped.extension[:]
        for declared in file.extension:
            message = declared.extendee.rpartition(".")[2]
            if message not in scopes:
                scopes[message] = scoped.message_type.add(name=SCOPE + message)
            own = scopes[message].extension.add()
            own.CopyFrom(declared)
            own.number = _free_number(own.extendee, own.number, taken)
            taken.add((own.extendee, own.number))
        try:
            add_file(scoped)
        except TypeError as fault:
            raise SpecError(f"these declarations do not fit Caffe's schema: {fault}", Where(file.name)) from None
        for message, scope in scopes.items():
            for declared in scope.extension:
                add_field(declared, pool.FindExtensionByName(extension_name(file.package, message, declared.name)))
        _declared[dialect.name] = dialect, scoped
        _taken.update(taken)
        return scoped


def _free_number(message: str, wanted: int, taken: set[tuple[str, int]]) -> int:
    """Return a number for another field of a message: the wanted one, or the first free one from 2000."""
    ranges = pool.FindMessageTypeByName(message).extension_ranges
    free = (n for first, last in ranges for n in range(max(first, 2000), last) if (message, n) not in taken)
    fits = any(first <= wanted < last for first, last in ranges) and (message, wanted) not in taken
    return wanted if fits else next(free)


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
