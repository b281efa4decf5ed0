"""Parses the part of the .proto language in which dialects declare their additions, into descriptors.

It supports messages, enums inside or outside messages, optional, repeated and required fields with ``default`` and
``packed``, and ``extend``. Comments stand between statements.
"""

from __future__ import annotations

import re
from functools import partial
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto

from netspec.errors import SpecError, Where

_BETWEEN = re.compile(r"(?:\s+|//[^\n]*|/\*.*?\*/)*", re.DOTALL)
_STATEMENT = re.compile(
    r"""(?P<block> message | enum | extend ) \s+ (?P<name> [\w.]+ ) \s* \{
      | (?P<end> \} )
      | (?P<label> optional | required | repeated ) \s+ (?P<type> [\w.]+ ) \s+ (?P<field> \w+ ) \s* = \s*
        (?P<number> \w+ ) \s* (?: \[ (?P<options> (?: [^\]"] | "[^"]*" )* ) \] \s* )? ;
      | (?P<value> \w+ ) \s* = \s* (?P<of_value> -?\w+ ) \s* ;
    """,
    re.VERBOSE,
)
_OPTION = re.compile(r'\s*(default|packed)\s*=\s*("[^"]*"|[^\s,"]+)\s*(?:,|$)')
_SCALARS = ("double", "float", "int64", "uint64", "int32", "uint32", "bool", "string", "bytes")
_EXPECTED = "expected message, enum, extend, or a field such as optional float scale = 1 [default = 2];"


def read_declarations(source: str, file: str, package: str) -> FileDescriptorProto:
    """Return the descriptor of declarations in a package, as additions to caffe.proto.

    Types are kept as written, for a descriptor pool to resolve. Raises SpecError for a syntax error.
    """
    result = FileDescriptorProto(name=file, package=package, syntax="proto2", dependency=["caffe.proto"])
    blocks: list[Any] = [result]  # those that are open: descriptors, and what adds a field of an ``extend``
    position = 0
    while (position := _BETWEEN.match(source, position).end()) < len(source):  # type: ignore[union-attr]
        found = _STATEMENT.match(source, position)
        try:
            _add(blocks, found)
        except (AttributeError, TypeError, ValueError):  # a wrong number, or what this block cannot have
            words = source[position:].splitlines()[0][:50]
            raise _error(source, file, position, f'{_EXPECTED} found "{words}"') from None
        position = found.end()  # type: ignore[union-attr]
    if len(blocks) > 1:
        raise _error(source, file, position, "the declarations end too early")
    return result


def _add(blocks: list[Any], found: Any) -> None:
    """Add a statement to the block that was opened last."""
    inner, name = blocks[-1], found["name"]
    if found["block"] == "message":
        blocks.append((inner.message_type if inner is blocks[0] else inner.nested_type).add(name=name))
    elif found["block"] == "enum":
        blocks.append(inner.enum_type.add(name=name))
    elif found["block"] and inner is blocks[0]:
        blocks.append(partial(inner.extension.add, extendee=name))
    elif found["end"] and len(blocks) > 1:
        blocks.pop()
    elif found["value"]:
        inner.value.add(name=found["value"], number=int(found["of_value"], 0))
    else:
        field: Any = inner() if callable(inner) else inner.field.add()
        _fill(field, found)


def _fill(field: FieldDescriptorProto, found: Any) -> None:
    field.name, field.number = found["field"], int(found["number"], 0)
    field.label = FieldDescriptorProto.Label.Value(f"LABEL_{found['label'].upper()}")
    if found["type"] in _SCALARS:
        field.type = FieldDescriptorProto.Type.Value(f"TYPE_{found['type'].upper()}")
    else:
        field.type_name = found["type"]
    options = found["options"] or ""
    while options:
        option = _OPTION.match(options)
        name, value = option.groups()  # type: ignore[union-attr]
        if name == "packed":
            field.options.packed = value == "true"
        elif value.lower().startswith(("0x", "-0x")):
            field.default_value = str(int(value, 0))
        else:
            field.default_value = value.strip('"')
        options = options[option.end() :]  # type: ignore[union-attr]


def _error(source: str, file: str, position: int, message: str) -> SpecError:
    line = source.count("\n", 0, position) + 1
    return SpecError(message, Where(file, line, position - source.rfind("\n", 0, position)))
