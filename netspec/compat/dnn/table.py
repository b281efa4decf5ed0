"""The layers of a net with OpenCV's numbers and names.

Layer 0, "_input", represents all inputs. A Convolution has the name of its top, and is one layer for each top. A name
that occurs again gets a number at the end. An Axpy becomes two layers.
OpenCV: modules/dnn/src/caffe/caffe_importer.cpp (4.12)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from netspec.graph.plan import Plan
from netspec.proto.schema import LayerParameter, NetParameter

INPUT = "_input"


@dataclass(frozen=True)
class Entry:
    """One of OpenCV's layers: its name and type, and its position in the filtered net: the layer, and the first top.

    ``top`` is -1 if it has none: the input layer, a Silence, the first half of an Axpy.
    """

    name: str
    type: str
    layer: int = -1
    top: int = -1


def make_table(net: NetParameter) -> list[Entry]:
    """Return the layers of a filtered net; the index in the list is OpenCV's number."""
    entries = [Entry(INPUT, "")]
    seen: Counter[str] = Counter()
    for i, layer in enumerate(net.layer):
        entries += _entries(i, layer, seen)
    return entries


def _entries(i: int, layer: LayerParameter, seen: Counter[str]) -> list[Entry]:
    name = _numbered(layer.name, seen)
    if layer.type == "Input":
        return []
    if layer.type == "Convolution":
        return [Entry(top, layer.type, i, j) for j, top in enumerate(layer.top)]
    top = 0 if layer.top else -1
    if layer.type == "Axpy":
        return [Entry(_numbered(f"{name}/scale", seen), "Scale", i), Entry(name, "Eltwise", i, top)]
    return [Entry(name, _TYPES.get(layer.type, layer.type), i, top)]


_TYPES = {"ConvolutionDepthwise": "Convolution"}


def _numbered(name: str, seen: Counter[str]) -> str:
    seen[name] += 1
    return name if seen[name] == 1 else f"{name}_{seen[name] - 1}"


def edges(net: NetParameter, table: Sequence[Entry]) -> list[tuple[int, int]]:
    """Return a pair of numbers (layer, reader) for each layer that reads a top of another."""
    producer: dict[str, int] = {}
    found: list[tuple[int, int]] = []
    entries: dict[int, list[int]] = {}
    for number, entry in enumerate(table):
        entries.setdefault(entry.layer, []).append(number)
    for i, layer in enumerate(net.layer):
        numbers = entries.get(i, [0])
        readers = numbers if layer.type == "Convolution" else [numbers[0]] * len(layer.bottom)
        found += [(producer[blob], n) for blob, n in zip(layer.bottom, readers, strict=False) if blob in producer]
        found += pairwise(numbers) if layer.type == "Axpy" else ()
        for j, blob in enumerate(layer.top):
            producer[blob] = numbers[min(j, len(numbers) - 1)] if layer.type == "Convolution" else numbers[-1]
    return found


def unconnected(net: NetParameter, table: Sequence[Entry]) -> list[int]:
    """Return the numbers of the layers whose tops no other layer reads."""
    read = {number for number, _ in edges(net, table)}
    return [number for number in range(len(table)) if number not in read]


def nodes_of(plan: Plan, net: NetParameter) -> list[int]:
    """Return for each layer of the filtered net its node in the plan, which also has Split layers."""
    nodes: list[int] = []
    for i, node in enumerate(plan.nodes):
        layer = net.layer[len(nodes)] if len(nodes) < len(net.layer) else None
        if layer is not None and (node.name, node.type) == (layer.name, layer.type):
            nodes.append(i)
    return nodes
