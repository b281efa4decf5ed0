"""Caffe's schema with the additions of dialects as ordinary messages and fields.

:mod:`netspec.dialects.registry` adds the fields of dialects as extensions, so that each net has its own. Programs for a
fork use them as fields of the fork's ``caffe_pb2``: ``layer.permute_param.order``. This module makes their
classes. They have the same text format, and the same binary format except for values added to Caffe's enums.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool

from netspec.dialects.registry import Dialect, full_name_of
from netspec.errors import SpecError, Where
from netspec.proto.schema import PACKAGE, pool

_FILE = "caffe.proto"


@cache
def merged_file(dialects: tuple[Dialect, ...]) -> Any:
    """Return the descriptor of caffe.proto with these dialects; without any, the schema's own.

    Raises SpecError if two of them have different messages with the same name.
    """
    if not dialects:
        return pool.FindFileByName(_FILE)
    file = descriptor_pb2.FileDescriptorProto()
    pool.FindFileByName(_FILE).CopyToProto(file)
    messages = {declared.name: declared for declared in file.message_type}
    for declared in messages.values():
        del declared.extension_range[:]
    for dialect in dialects:
        additions = descriptor_pb2.FileDescriptorProto()
        additions.CopyFrom(dialect.declarations)
        for declared in additions.message_type:
            _add_message(file, messages, declared, dialect)
        values = dialect.values()
        replaced = {f.type_name for f in additions.extension if (full_name_of(f.extendee), f.name) in values}
        file.enum_type.extend(enum for enum in additions.enum_type if enum.name not in replaced)
        for field in additions.extension:
            extended = messages[field.extendee.rpartition(".")[2]]
            if names := values.get((full_name_of(field.extendee), field.name)):
                _add_values(extended, field.name, names)
                continue
            field.ClearField("extendee")
            extended.field.append(field)
    merged = descriptor_pool.DescriptorPool()
    merged.Add(file)
    return merged.FindFileByName(_FILE)


def _add_values(extended: descriptor_pb2.DescriptorProto, field: str, names: Sequence[str]) -> None:
    """Add the values ``names`` to the enum of one of Caffe's fields, with numbers after its own."""
    enum = next(f.type_name for f in extended.field if f.name == field).rpartition(".")[2]
    values = next(found.value for found in extended.enum_type if found.name == enum)
    for name in names:
        values.add(name=name, number=1 + max(value.number for value in values))


def _add_message(
    file: descriptor_pb2.FileDescriptorProto,
    messages: dict[str, descriptor_pb2.DescriptorProto],
    declared: descriptor_pb2.DescriptorProto,
    dialect: Dialect,
) -> None:
    known = messages.get(declared.name)
    if known is None:
        file.message_type.append(declared)
        messages[declared.name] = file.message_type[-1]
    elif known != declared:
        message = f'another dialect, or Caffe, has another message "{PACKAGE}.{declared.name}"'
        raise SpecError(message, Where(dialect.declarations.name))
