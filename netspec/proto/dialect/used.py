"""Which dialects a message uses."""

from __future__ import annotations

from typing import Any

from google.protobuf.message import Message

from netspec.proto.schema import PACKAGE


def dialects_in(message: Message) -> set[str]:
    """Return the dialects whose fields a message, or one inside it, has."""
    found: set[str] = set()
    fields: Any = message.ListFields()
    for field, value in fields:
        if field.is_extension:
            found.add(field.file.package.removeprefix(f"{PACKAGE}."))
        if field.message_type is not None:
            values = [value] if isinstance(value, Message) else value
            found.update(*(dialects_in(each) for each in values))
    return found
