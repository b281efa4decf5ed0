"""Reads messages in protobuf's binary format: .caffemodel, .solverstate, .binaryproto."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from google.protobuf.message import DecodeError, Message

from netspec.errors import SpecError, Where
from netspec.files.kinds import kind_of, pointer_fault, unreadable
from netspec.files.limits import read_bytes
from netspec.proto.schema import NetParameter
from netspec.proto.source_map import SourceMap
from netspec.proto.upgrade.current import upgrade_net
from netspec.proto.wire import fields, without_numbers

M = TypeVar("M", bound=Message)
MOST_BYTES = 2**31 - 1  # of a message


def read_binary(path: str | Path, message_class: type[M]) -> M:
    """Return the message in a file.

    Raises SpecError for a file that cannot be read, is empty, or has other contents. Protobuf's binary format has no
    signature: data that decodes without any known field counts as other contents.
    """
    try:
        data = read_bytes(path)
    except OSError as fault:
        raise SpecError(unreadable(path, fault), Where(str(path))) from None
    return parse_binary(data, str(path), message_class)


def parse_binary(data: bytes, file: str, message_class: type[M]) -> M:
    """Return the message in ``data``; ``file`` is its name in errors. Raises as :func:`read_binary`."""
    where = Where(file)
    name = message_class.DESCRIPTOR.name
    if not data:
        raise SpecError(f"the file is empty, expected a binary {name}", where)
    if fault := pointer_fault(data):
        raise SpecError(fault, where)
    message = message_class()
    try:
        message.ParseFromString(data)
        known = bool(message.ListFields())
    except DecodeError:
        known = False
    if not known:
        message = f"expected a binary {name}, found {_guess(data, message_class)}"
        raise SpecError(message, where)
    _escape_names(message)
    return message


def _escape_names(message: Any) -> None:
    """Write bytes of names that are not UTF-8 as escapes, since Python's protobuf refuses them (C++ does not)."""
    for field, value in message.ListFields():
        parts: Any = value if isinstance(value, Sequence) and not isinstance(value, (str, bytes)) else [value]
        if field.message_type:
            for part in parts:
                _escape_names(part)
        elif field.type == field.TYPE_STRING and any(isinstance(part, bytes) for part in parts):
            escaped = [part.decode(errors="backslashreplace") if isinstance(part, bytes) else part for part in parts]
            if parts is value:
                parts[:] = escaped
            elif field.is_extension:
                message.Extensions[field] = escaped[0]
            else:
                setattr(message, field.name, escaped[0])


def read_net_binary(path: str | Path) -> NetParameter:
    """Return the net of a .caffemodel, upgraded to the current format. Raises SpecError."""
    return parse_net_binary(path)[0]


@contextmanager
def net_without_numbers(path: str | Path) -> Iterator[tuple[NetParameter, BinaryIO | None]]:
    """Yield the net of a .caffemodel without the numbers of its large blobs, and the open file that contains them.

    See :func:`netspec.proto.wire.without_numbers`. If that is not possible, yield the complete net, and None.
    Raises SpecError as :func:`read_net_binary`.
    """
    with ExitStack() as stack:
        try:
            if not os.path.isfile(path):
                raise ValueError("not a file, so its parts cannot be read separately")
            file = stack.enter_context(open(path, "rb", buffering=0))
            message = without_numbers(_Slices(file), 0, os.fstat(file.fileno()).st_size, "NetParameter")
            found = _upgraded(parse_binary(message, str(path), NetParameter), path)[0], file
        except (OSError, ValueError):  # also SpecError: reading the whole file may raise a better error
            stack.close()
            found = read_net_binary(path), None
        yield found


class _Slices:
    """A file that is read by slicing it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def __getitem__(self, part: slice) -> bytes:
        self._file.seek(part.start)
        data = self._file.read(part.stop - part.start)
        if len(data) < part.stop - part.start:
            raise ValueError("the file is truncated")
        return data


def parse_net_binary(path: str | Path, upgrade: bool = True) -> tuple[NetParameter, SourceMap]:
    """Return the net of a .caffemodel, and a map that has only the file name. Raises SpecError."""
    net = read_binary(path, NetParameter)
    return _upgraded(net, path, upgrade)


def _upgraded(net: NetParameter, path: str | Path, upgrade: bool = True) -> tuple[NetParameter, SourceMap]:
    source = SourceMap.unknown(str(path), len(net.layer) + len(net.layers))
    return upgrade_net(net, source) if upgrade else (net, source)


def split_paths(paths: str | Path) -> list[str]:
    """Return the weights files of a list separated by commas, as in Caffe's ``--weights``."""
    return [path.strip() for path in str(paths).split(",")]


def check_readable(paths: Iterable[str]) -> None:
    """Raise SpecError for the first path that cannot be opened. Call it before a net is built, which may take long."""
    for path in paths:
        try:
            open(path, "rb").close()
        except (OSError, ValueError) as fault:  # ValueError: a NUL in the name
            raise SpecError(unreadable(path, fault), Where(path)) from None


def is_net_binary(path: str | Path) -> bool:
    """Return whether a file is a .caffemodel: whether it contains the layers of a net in protobuf's binary format."""
    try:
        data = read_bytes(path)
        if b"\0" not in data:  # binary numbers contain NUL, and text does not
            return False
        net = NetParameter.FromString(data)
    except (OSError, DecodeError):
        return False
    return bool(net.layer or net.layers)


def _guess(data: bytes, message_class: type[Message]) -> str:
    """Return a guess at the contents of a file that is not such a message."""
    if kind := kind_of(data):
        return kind
    if all(32 <= byte < 127 or byte in b"\t\r\n" for byte in data[:1000]):
        return "text"
    known = message_class.DESCRIPTOR.fields_by_number
    with suppress(ValueError):
        # A length that is too large for the file is not an error here: the file may be the first part of a larger one.
        for field in fields(data, 0, len(data) + MOST_BYTES):
            if field.number not in known:
                break
            if field.end > len(data):
                return f"its first {len(data):,} bytes only: it was truncated; copy or download it again"
    return "another kind of data, or a truncated file"
