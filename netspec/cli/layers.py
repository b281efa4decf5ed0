"""``netspec layers``."""

from __future__ import annotations

import argparse

from netspec.cli.run import READ, Commands


def add_to(commands: Commands) -> None:
    """Add the command."""
    commands.add("layers", _layers, "list the layer types, each with its description", quiet=True, net=READ)


def _layers(arguments: argparse.Namespace) -> None:
    from netspec.layers import layer_class, layer_types

    for name in layer_types():
        cls = layer_class(name)
        first = ((cls and cls.__doc__) or "").strip().splitlines()[0]
        print(f"{name:28} {first}")
