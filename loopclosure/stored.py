"""Reading what a map, a detector or a word model stores: checked arrays, and dataclasses in JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar, cast

import numpy as np

T = TypeVar("T")


def check_array(arrays: Mapping[str, Any], name: str, kinds: str, shape: tuple[int, ...], finite: bool = True) -> None:
    """Raise ValueError if an array is missing, has another kind or shape, or contains a NaN or an infinity."""
    values = arrays.get(name)
    if values is None:
        raise ValueError(f'has no array "{name}"')
    if values.dtype.kind not in kinds or values.shape != shape:
        raise ValueError(f'"{name}" has shape {values.shape}, {values.dtype}; expected {shape}')
    if finite and not np.all(np.isfinite(values)):
        raise ValueError(f'"{name}" contains a NaN or an infinity')


def from_json(made: type[T], values: Any) -> T:
    """Return an object of a dataclass made from a JSON value. Its fields are numbers, strings, Booleans or None.

    Raises ValueError for a missing field or one of another type, and the exceptions of the class.
    """
    known = {field.name: str(field.type).split(" | ") for field in fields(cast(Any, made))}
    if not isinstance(values, dict) or set(values) != set(known):
        raise ValueError(f"found {values!r:.80}, expected the fields {', '.join(known)}")
    for name, types in known.items():
        value = values[name]
        kind = "None" if value is None else type(value).__name__
        if kind not in types and not (kind == "int" and "float" in types):
            raise ValueError(f"{name} is {value!r:.80}, expected {' or '.join(types)}")
    return made(**values)
