"""Input layers: how a net names what its caller gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from netspec.proto.schema import LayerParameter, NetParameter

INPUT = "Input"


def is_input(layer: LayerParameter) -> bool:
    """Return whether the tops of a layer are given by the caller."""
    return layer.type == INPUT


def add_input(net: NetParameter, name: str, shapes: Mapping[str, Sequence[int]]) -> None:
    """Append an Input layer whose tops have these shapes."""
    entry = net.layer.add(name=name, type=INPUT, top=list(shapes))
    for shape in shapes.values():
        entry.input_param.shape.add().dim.extend(shape)


def shapes_of_input(layer: LayerParameter) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the tops of an Input layer, as far as it has them; one may stand for all."""
    shapes = [tuple(shape.dim) for shape in layer.input_param.shape]
    return dict(zip(layer.top, shapes * len(layer.top) if len(shapes) == 1 else shapes, strict=False))
