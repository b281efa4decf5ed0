"""Checks of settings that layers of many forks have."""

from __future__ import annotations

from netspec.layers import Layer
from netspec.proto.schema import value


def check_at_least_1(layer: Layer, group: str, *names: str) -> None:
    """Raise SpecError for one of these settings of ``group`` that is 0, or that is not given and has no default."""
    for name in names:
        if getattr(value(layer.param, group), name) < 1:
            raise layer.error(f"{name} must be given and be at least 1", group, name)
