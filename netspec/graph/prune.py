"""The part of a net that computes some blobs from others: with it a training net gives features of images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from netspec.graph import check_blobs
from netspec.graph.inputs import add_input
from netspec.proto.schema import NetParameter
from netspec.proto.source_map import SourceMap
from netspec.proto.upgrade.rewrite import copy_without


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
    places = []
    for name, shape in given.items():
        add_input(pruned, name, {name: shape})
        places.append(source.net)
    for i in reversed(kept):
        pruned.layer.add().CopyFrom(net.layer[i])
        places.append(source.layers[i])
    return pruned, source.with_layers(places)
