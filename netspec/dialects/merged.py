"""Caffe's schema with the additions of dialects as ordinary messages and fields.

:mod:`netspec.dialects.registry` adds the fields of dialects as extensions, so that each net has its own. Programs for a
fork use them as fields of the fork's ``caffe_pb2``: ``layer.permute_param.order``. This module makes their classes.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool

from netspec.dialects.registry import Dialect, declare
from netspec.errors import SpecError, Where
from netspec.proto.schema import PACKAGE, SCOPE, pool

_FILE = "caffe.proto"


@cache
def merged_file(dialects: tuple[Dialect, ...]) -> Any:
    """Return the descriptor of caffe.proto with these dialects; without any, the schema's own.

    Raises SpecError if two of them have different messages, or a field, with the same name.
    """
    if not dialects:
        return pool.FindFileByName(_FILE)
    file = descriptor_pb2.FileDescriptorProto()
    pool.FindFileByName(_FILE).CopyToProto(file)
    messages = {declared.name: declared for declared in file.message_type}
    for declared in messages.values():
        del declared.extension_range[:]
    for dialect in dialects:
        additions, values = declare(dialect), dialect.values()
        for declared in additions.message_type:
            if declared.name.startswith(SCOPE):
                _extend(messages[declared.name.removeprefix(SCOPE)], declared.extension, values)
            elif declared.name not in messages:
                file.message_type.append(declared)
                messages[declared.name] = file.message_type[-1]
            elif messages[declared.name] != declared:
                message = f'another dialect, or Caffe, has another message "{PACKAGE}.{declared.name}"'
                raise SpecError(message, Where(additions.name))
        replaced = {f.type_name for f in dialect.declarations.extension if (f.extendee, f.name) in values}
        file.enum_type.extend(enum for enum in additions.enum_type if enum.name not in replaced)
    merged = descriptor_pool.DescriptorPool()
    try:
        merged.Add(file)
    except TypeError as fault:
        names = " and ".join(dialect.name for dialect in dialects)
        raise SpecError(f"the dialects {names} do not fit together: {fault}") from None
    return merged.FindFileByName(_FILE)


def _extend(message: descriptor_pb2.DescriptorProto, fields: Any, values: Any) -> None:
    """Add fields to one of Caffe's messages, and values to its enums, with numbers after their own."""
    for field in fields:
        if names := values.get((f"{PACKAGE}.{message.name}", field.name)):
            kind = next(own.type_name for own in message.field if own.name == field.name).rpartition(".")[2]
            enum = next(own.value for own in message.enum_type if own.name == kind)
            for name in names:
                enum.add(name=name, number=1 + max(value.number for value in enum))
            continue
        message.field.append(field)
        message.field[-1].ClearField("extendee")
