"""Input layers, and the part of a net between given and wanted blobs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from netspec.data.blobs import Shape
from netspec.errors import SpecError, Where, check_blobs, did_you_mean
from netspec.proto.schema import LayerParameter, NetParameter, copy_without
from netspec.proto.source_map import SourceMap

INPUT = "Input"


def is_input(layer: LayerParameter) -> bool:
    """Return whether the tops of a layer are given by the caller."""
    return layer.type == INPUT


def add_input(net: NetParameter, name: str, shapes: Mapping[str, Sequence[int]]) -> None:
    """Append an Input layer with tops of these shapes."""
    entry = net.layer.add(name=name, type=INPUT, top=list(shapes))
    for shape in shapes.values():
        entry.input_param.shape.add().dim.extend(shape)


def shapes_of_input(layer: LayerParameter) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the tops of an Input layer, as far as given. A single shape applies to all."""
    shapes = [tuple(shape.dim) for shape in layer.input_param.shape]
    return dict(zip(layer.top, shapes * len(layer.top) if len(shapes) == 1 else shapes, strict=False))


def prune(
    net: NetParameter, source: SourceMap, wanted: Sequence[str], given: Mapping[str, Sequence[int]]
) -> tuple[NetParameter, SourceMap]:
    """Return the filtered net with only the layers that are needed for the ``wanted`` blobs.

    The layer that first writes a blob of ``given`` (name -> shape) is replaced by an Input layer of that shape; layers
    that change it in place are kept. Raises SpecError for a blob that the net does not have.
    """
    check_blobs((*wanted, *given), (top for layer in net.layer for top in layer.top), source.file)
    needed = set(wanted)
    kept: list[int] = []
    for i in reversed(range(len(net.layer))):
        layer = net.layer[i]
        made = {top for top in layer.top if top in needed}
        if not made:
            continue
        fresh = {top for j, top in enumerate(layer.top) if j >= len(layer.bottom) or layer.bottom[j] != top}
        if made & fresh and made <= set(given):
            continue  # an Input layer replaces it
        kept.append(i)
        needed -= fresh - set(given)
        needed.update(layer.bottom)
    pruned = copy_without(net, {"layer"})
    positions = []
    for name, shape in given.items():
        add_input(pruned, name, {name: shape})
        positions.append(source.net)
    for i in reversed(kept):
        pruned.layer.add().CopyFrom(net.layer[i])
        positions.append(source.layers[i])
    return pruned, source.with_layers(positions)


def wrong_given_shapes(shapes: Mapping[str, Shape], nets: Sequence[NetParameter], path: str | Path) -> list[SpecError]:
    """Return an error for each given shape of a blob that is not a top of a data layer (or Python layer)."""
    from netspec.layers import class_of  # imports torch, which a stored model of another engine does not need
    from netspec.layers.utility.python import Python  # its code need not run if the shapes are given

    layers = [layer for net in nets for layer in net.layer]
    makers = [layer for layer in layers if not layer.bottom or issubclass(class_of(layer) or object, Python)]
    blobs = list(dict.fromkeys(top for layer in makers for top in layer.top))
    known = ", ".join(blobs) or "none"
    return [
        SpecError(
            f'--shape: no data layer has a top "{name}"{did_you_mean(name, blobs) or ";"} their tops: {known}',
            Where(str(path)),
        )
        for name in shapes
        if name not in blobs
    ]
