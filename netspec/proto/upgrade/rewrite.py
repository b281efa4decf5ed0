"""Functions for the upgrade passes: building messages from parts of others, which keep their original positions."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from google.protobuf.message import Message

from netspec.errors import Where
from netspec.proto.schema import Field, fields_of, given, same_field
from netspec.proto.source_map import Position


class Draft:
    """A message under construction, and the positions of its parts."""

    def __init__(self, message: Message, where: Where) -> None:
        """``message`` is the message to fill; ``where`` is the position of the whole message."""
        self.message: Any = message
        self.where = where
        self.positions: dict[str, tuple[Position, ...]] = {}
        self._inner: dict[str, Draft] = {}

    def copy(self, message: Message, positions: Position, leave_out: Collection[str] = ()) -> None:
        """Copy all fields of a message that this one also has, except those to omit."""
        for field in given(message):
            if field.name not in leave_out and (mine := same_field(field, self.message)):
                self._put(mine, field.get(message), positions.fields.get(field.name, ()))

    def put(self, name: str, value: Any, positions: tuple[Position, ...]) -> None:
        """Set a field, or add one or several values to a repeated one."""
        self._put(fields_of(self.message.DESCRIPTOR)[name], value, positions)

    def _put(self, field: Field, value: Any, positions: tuple[Position, ...]) -> None:
        field.assign(self.message, value)
        before = self.positions.get(field.name, ()) if field.repeated else ()
        self.positions[field.name] = (*before, *positions)

    def inner(self, name: str, where: Where) -> Draft:
        """Return the draft of a singular message field; a new draft is empty and has the position ``where``."""
        if name not in self._inner:
            positions = self.positions.pop(name, ())
            self._inner[name] = draft = Draft(getattr(self.message, name), positions[0].where if positions else where)
            draft.message.SetInParent()
            draft.positions = dict(positions[0].fields) if positions else {}
        return self._inner[name]

    def position(self) -> Position:
        """Return the positions of all parts."""
        inner = {name: (draft.position(),) for name, draft in self._inner.items()}
        return Position(self.where, {**self.positions, **inner})
