"""Works out the shapes of all values of a net for inputs of other shapes."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer, Shape


def fitted(
    plan: Plan, layers: Sequence[Layer], given: Mapping[int, Shape]
) -> tuple[list[Layer | None], dict[int, Shape]]:
    """Return copies of the layers, reshaped for values of the shapes ``given``, and the shapes of all values.

    A shape that depends on values is left out. The copy of a layer is None if a shape of its bottoms is unknown, or if
    the layer keeps state between passes. Raises SpecError if a layer cannot take its bottoms.
    """
    shapes = dict(given)
    found: list[Layer | None] = []
    for node, layer in zip(plan.nodes, layers, strict=True):
        known = bool(node.bottoms) and all(v in shapes for v in node.bottoms)
        if known and not layer.changes_itself:
            layer = copy.copy(layer)
            layer.fit([shapes[v] for v in node.bottoms])
            if layer.counted_axis is None:
                shapes.update(zip(node.tops, layer.top_shapes, strict=False))
            found.append(layer)
        else:
            found.append(None)
    return found, shapes
