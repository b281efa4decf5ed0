"""Writing a message as text, as in Caffe's log (DebugString of protobuf for C++)."""

from __future__ import annotations

import struct
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Declared
from google.protobuf.message import Message

from netspec.proto.schema import Field, given

_ESCAPES = {9: "\\t", 10: "\\n", 13: "\\r", 34: '\\"', 39: "\\'", 92: "\\\\"}


def write_text(message: Message) -> str:
    """Return a message as protobuf text: one line per field, in the order of field numbers, indented by two spaces."""
    lines: list[str] = []
    _write(message, "", lines)
    return "".join(f"{line}\n" for line in lines)


def _write(message: Message, indent: str, lines: list[str]) -> None:
    for field in given(message):
        for value in field.get(message) if field.repeated else [field.get(message)]:
            if field.type == Declared.TYPE_MESSAGE:
                lines.append(f"{indent}{field.name} {{")
                _write(value, indent + "  ", lines)
                lines.append(f"{indent}}}")
            else:
                lines.append(f"{indent}{field.name}: {scalar_text(field, value)}")


def scalar_text(field: Field, value: Any) -> str:
    """Return the value of a scalar field as text, as in a prototxt."""
    if field.type == Declared.TYPE_FLOAT:
        return _shortest(value, 6, 9, "f")
    if field.type == Declared.TYPE_DOUBLE:
        return _shortest(value, 15, 17, "d")
    if field.type == Declared.TYPE_BOOL:
        return "true" if value else "false"
    if field.type == Declared.TYPE_ENUM:
        return field.descriptor.enum_type.values_by_number[value].name
    if field.type in (Declared.TYPE_STRING, Declared.TYPE_BYTES):
        return f'"{_escaped(value.encode() if isinstance(value, str) else value)}"'
    return str(value)


def _shortest(value: float, digits: int, all_digits: int, kind: str) -> str:
    """Format a number with few digits if they give the same value when read, else with enough digits for any value."""
    text = f"{value:.{digits}g}"
    same = struct.unpack(kind, struct.pack(kind, float(text)))[0] == value
    return text if same or value != value else f"{value:.{all_digits}g}"


def _escaped(data: bytes) -> str:
    return "".join(_ESCAPES.get(b) or (chr(b) if 32 <= b < 127 else f"\\{b:03o}") for b in data)
