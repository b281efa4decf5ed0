"""The settings of a method on the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from loopclosure.errors import InputError

YES_NO = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
# Not settable: the name belongs to the method, the seed to the whole evaluation.
FIXED = ("name", "seed")


def configure(method: str, settings: Mapping[str, str], *parts: Any) -> list[Any]:
    """Return the dataclasses ``parts`` with the settings, each parsed to the type of its field's default.

    No two parts have a setting of one name. Raises InputError for an unknown setting, or a value of another type.
    """
    known = {f.name: i for i, part in enumerate(parts) for f in fields(part) if _settable(part, f.name)}
    changes: list[dict[str, Any]] = [{} for _ in parts]
    for key, value in settings.items():
        if key not in known:
            raise InputError(f'{method} has no setting "{key}"; known: {", ".join(sorted(known))}')
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
