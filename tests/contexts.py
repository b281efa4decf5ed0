"""Contexts of layers that are built without a net."""

from dataclasses import fields
from typing import Any

from netspec.graph.options import BuildOptions
from netspec.layers.contract.context import Context

_OPTIONS = frozenset(field.name for field in fields(BuildOptions))


def context(**facts: Any) -> Context:
    """Return a Context; ``facts`` are fields of it, or of its options."""
    options = {name: fact for name, fact in facts.items() if name in _OPTIONS}
    return Context(options=BuildOptions(**options), **{k: v for k, v in facts.items() if k not in _OPTIONS})
