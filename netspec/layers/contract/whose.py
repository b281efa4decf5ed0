"""Whose a layer is, where several forks have layers of its type with other numbers."""

from __future__ import annotations

from netspec.layers.contract.base import Layer


def whose(layer: Layer) -> str:
    """Return the dialect whose layer this is, of ``layer.forks``: one that the net uses, else the first and a warning.

    The net says what ``layer.unsure`` then has (netspec/net/ignored_fields.py).
    """
    used = [dialect for dialect in layer.forks if dialect in layer.context.options.dialects]
    if used:
        return used[-1]
    names = [name for name, numbers in layer.forks.items() if numbers]
    first, *others = (f'"{name}" ({layer.forks[name]})' for name in names)
    layer.unsure = (
        "forks have other layers of this type, and nothing here shows whose it is; it is computed as that of "
        f'{first}, not of {" or ".join(others)}; to choose, write a line "# dialect: {names[-1]}" into the '
        f"prototxt, or pass --plugin {names[-1]}"
    )
    return names[0]
