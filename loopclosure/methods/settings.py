"""The argument of a method on the command line: ``setting=value,setting=value``."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from loopclosure.errors import InputError

YES_NO = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
# Not settable: the name belongs to the method, the seed to the whole evaluation.
FIXED = ("name", "seed")


def configure(method: str, argument: str, *parts: Any) -> list[Any]:
    """Return the dataclasses ``parts`` with the settings in ``argument``.

    A setting goes to the first part that has a field of that name, and is parsed to the type of the field's default.
    Raises InputError for an unknown setting, or a value of another type.
    """
    changes: list[dict[str, Any]] = [{} for _ in parts]
    known = {f.name: i for i, part in reversed(list(enumerate(parts))) for f in fields(part) if _settable(part, f.name)}
    for item in filter(None, (text.strip() for text in argument.split(","))):
        key, equals, value = (text.strip() for text in item.partition("="))
        if not equals or key not in known:
            raise InputError(f'{method} has no setting "{item}"; write setting=value with {", ".join(sorted(known))}')
        changes[known[key]][key] = _read(method, key, value, getattr(parts[known[key]], key))
    return [replace(part, **changed) for part, changed in zip(parts, changes, strict=True)]


def _settable(part: Any, name: str) -> bool:
    return name not in FIXED and isinstance(getattr(part, name), (bool, int, float, str))


def _read(method: str, key: str, value: str, default: bool | int | float | str) -> bool | int | float | str:
    try:
        return YES_NO[value.lower()] if isinstance(default, bool) else type(default)(value)
    except (KeyError, ValueError):
        expected = {bool: "yes or no", int: "a whole number", float: "a number"}[type(default)]
        raise InputError(f'{method}: {key} is {expected}, not "{value}"') from None
