"""Functions for the upgrade passes: building messages from parts of others, which keep their original places."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeVar

from google.protobuf.message import Message

from netspec.errors import Where
from netspec.proto.schema import Field, fields_of
from netspec.proto.source_map import Place

M = TypeVar("M", bound=Message)


class Draft:
    """A message under construction, and the places of its parts."""

    def __init__(self, message: Message, where: Where) -> None:
        """``message`` is the message to fill; ``where`` is the place of the whole message."""
        self.message: Any = message
        self.where = where
        self.places: dict[str, tuple[Place, ...]] = {}
        self._inner: dict[str, Draft] = {}

    def copy(self, message: Message, places: Place, leave_out: Collection[str] = ()) -> None:
        """Copy all fields of a message that this one also has, except those to omit."""
        for name, field in fields_of(message.DESCRIPTOR).items():
            if name not in leave_out and name in fields_of(self.message.DESCRIPTOR) and field.present(message):
                self.put(name, field.get(message), places.fields.get(field.name, ()))

    def put(self, name: str, value: Any, places: tuple[Place, ...]) -> None:
        """Set a field, or add one or several values to a repeated one."""
        field = fields_of(self.message.DESCRIPTOR)[name]
        _put(self.message, field, value)
        before = self.places.get(name, ()) if field.repeated else ()
        self.places[field.name] = (*before, *places)

    def inner(self, name: str, where: Where) -> Draft:
        """Return the draft of a singular message field; a new draft is empty and has the place ``where``."""
        if name not in self._inner:
            places = self.places.pop(name, ())
            self._inner[name] = draft = Draft(getattr(self.message, name), places[0].where if places else where)
            draft.message.SetInParent()
            draft.places = dict(places[0].fields) if places else {}
        return self._inner[name]

    def place(self) -> Place:
        """Return the places of all parts."""
        inner = {name: (draft.place(),) for name, draft in self._inner.items()}
        return Place(self.where, {**self.places, **inner})


def _put(message: Message, field: Field, value: Any) -> None:
    if field.repeated:
        several = not isinstance(value, (str, bytes, int, float, Message))
        field.get(message).extend(value if several else [value])
    elif isinstance(value, Message):
        field.get(message).CopyFrom(value)
    else:
        field.set(message, value)


def copy_without(message: M, leave_out: Collection[str]) -> M:
    """Return a copy of a message without some of its fields; these are never copied, not even temporarily."""
    result = type(message)()
    for name, field in fields_of(message.DESCRIPTOR).items():
        if name not in leave_out and field.present(message):
            _put(result, field, field.get(message))
    return result
