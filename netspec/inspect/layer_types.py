"""A list of the layer types, for ``netspec layers``."""

from __future__ import annotations

from collections.abc import Iterator

from netspec.layers import layer_class, layer_types


def layer_lines() -> Iterator[str]:
    """Yield one line for each layer type: its name, and the first line of the docstring of its class."""
    for name in layer_types():
        cls = layer_class(name)
        first = ((cls and cls.__doc__) or "").strip().splitlines()[0]
        yield f"{name:28} {first}"
