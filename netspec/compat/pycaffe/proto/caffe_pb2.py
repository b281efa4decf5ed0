"""All messages and enums of Caffe's schema and of dialects, under protoc's names.

The dialects are those that a user added, and those of the net that was loaded last: a fork's program loads a net and
then reads ``caffe_pb2.LabelMap()``, which its own Caffe has.

Nothing is generated, and nothing is added to protobuf's default pool, so another ``caffe_pb2`` in the process does
not conflict with this one. Without any, the classes are those of :mod:`netspec.proto.schema`.
Caffe: src/caffe/proto/caffe.proto
"""

from __future__ import annotations

from functools import cache
from typing import Any

from google.protobuf import message_factory
from google.protobuf.internal.enum_type_wrapper import EnumTypeWrapper

from netspec.errors import did_you_mean
from netspec.proto.forks import forks
from netspec.proto.schema import pool

_of_net: tuple[str, ...] = ()  # the dialects of the net that was loaded last


def __getattr__(name: str) -> Any:
    if name == "DESCRIPTOR":
        return _file()
    names = _names(_file())
    if name == "__all__":
        return [public for public in names if not public.startswith("_")]
    if name in names:
        return names[name]
    additions = forks().additions()
    advice = additions.advise(name, additions.messages.get(name, ()))
    hint = f"; {advice}" if advice else did_you_mean(name, list(names))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")


def __dir__() -> list[str]:
    return sorted(_names(_file()))


def _file() -> Any:
    """Return the descriptor of caffe.proto, with the additions of the dialects."""
    return forks().schema_file(_of_net) or pool.FindFileByName("caffe.proto")


@cache
def _names(file: Any) -> dict[str, Any]:
    """Return the names that protoc would generate for a file, with their values."""
    names: dict[str, Any] = {}
    for name, message in file.message_types_by_name.items():
        names[name] = message_factory.GetMessageClass(message)
        names[f"_{name.upper()}"] = message
    for name, enum in file.enum_types_by_name.items():
        names[name] = EnumTypeWrapper(enum)
        names[f"_{name.upper()}"] = enum
        names.update({value.name: value.number for value in enum.values})
    return names
