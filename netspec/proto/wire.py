"""Protobuf's wire format: finds the fields of a message without parsing it.

protobuf copies all numbers of a net's weights while it parses them, and passes them to Python one by one.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple, Protocol

from netspec.proto.schema import PACKAGE, BlobProto, pool

VARINT, EIGHT, BYTES, FOUR = 0, 1, 2, 5  # wire types: how a field's contents are stored
POSITION = (1 << 29) - 1  # the largest field number; see without_numbers
_LEAST = 256  # bytes: smaller blobs are copied
_HEAD = 20  # bytes: a tag and a size take at most 10 each
_WITH_BLOBS = ("BlobProto", "LayerParameter", "V1LayerParameter", "V0LayerParameter")
_DATA, _DOUBLE = (BlobProto.DESCRIPTOR.fields_by_name[name].number for name in ("data", "double_data"))


class Data(Protocol):
    """Bytes, or a file that is read by slicing it."""

    def __getitem__(self, part: slice, /) -> bytes:
        """Return a part."""
        ...


class Field(NamedTuple):
    """The number and wire type of a field, the offset of its tag, and the start and end of its contents."""

    number: int
    kind: int
    tag: int
    start: int
    end: int


def fields(data: Data, start: int, end: int) -> Iterator[Field]:
    """Yield the fields of the message between two offsets. Raises ValueError if there is no valid message."""
    while start < end:
        head = data[start : min(end, start + _HEAD)]
        tag, size = _varint(head, 0)
        contents = start + size
        kind = tag & 7
        if kind == VARINT:
            after = start + _varint(head, size)[1]
        elif kind == BYTES:
            count, size = _varint(head, size)
            contents = start + size
            after = contents + count
        elif kind in (EIGHT, FOUR):
            after = contents + (8 if kind == EIGHT else 4)
        else:
            raise ValueError(f"has a field of wire type {kind}")
        if after > end or not tag >> 3:
            raise ValueError("is truncated, or is not a protobuf message")
        yield Field(tag >> 3, kind, start, contents, after)
        start = after


def _varint(head: bytes, position: int) -> tuple[int, int]:
    """Return a number of one or more bytes, and where it ends."""
    found = shift = 0
    for end in range(position, len(head)):
        found |= (head[end] & 127) << shift
        if head[end] < 128:
            return found, end + 1
        shift += 7
    raise ValueError("is truncated, or is not a protobuf message")


def without_numbers(data: Data, start: int, end: int, message: str) -> bytes:
    """Return a serialized message of Caffe without the numbers of its large blobs.

    Such a blob has the field POSITION twice instead: the offset of its numbers (little-endian float32) in ``data``, and
    their size in bytes. Raises ValueError if the data is not such a message.
    """
    if message == "BlobProto":
        return _blob_without_numbers(data, start, end)
    inner, parts, verbatim = _messages_with_blobs(message), [], start
    for number, kind, tag, contents, after in fields(data, start, end):
        if kind == BYTES and number in inner:
            short = without_numbers(data, contents, after, inner[number])
            parts += [data[verbatim:tag], _tag(number, BYTES), _as_varint(len(short)), short]
            verbatim = after
    return b"".join([*parts, data[verbatim:end]])


def _blob_without_numbers(data: Data, start: int, end: int) -> bytes:
    found = list(fields(data, start, end))
    if any(field.number == POSITION for field in found):
        raise ValueError("uses a field number that is reserved for numbers")
    runs = [field for field in found if field.number in (_DATA, _DOUBLE)]
    if len(runs) != 1 or runs[0].number != _DATA or runs[0].kind != BYTES:
        return data[start:end]
    _, _, tag, contents, after = runs[0]
    if after - contents < _LEAST or (after - contents) % 4:
        return data[start:end]
    position = [_tag(POSITION, VARINT) + _as_varint(number) for number in (contents, after - contents)]
    return b"".join([data[start:tag], data[after:end], *position])


@cache
def _messages_with_blobs(message: str) -> dict[int, str]:
    """Return the names of the messages in a message that contain blobs, by field number."""
    inner = pool.FindMessageTypeByName(f"{PACKAGE}.{message}").fields
    kinds = {field.number: field.message_type.name for field in inner if field.message_type}
    return {number: name for number, name in kinds.items() if name in _WITH_BLOBS}


def _tag(number: int, kind: int) -> bytes:
    return _as_varint(number << 3 | kind)


def _as_varint(number: int) -> bytes:
    made = bytearray()
    while number > 127:
        made.append(number & 127 | 128)
        number >>= 7
    return bytes([*made, number])
