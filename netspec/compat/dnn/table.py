"""The layers of a net with OpenCV's numbers and names.

Layer 0, "_input", represents all inputs. A Convolution has the name of its top, and is one layer for each top. A name
that occurs again gets a number at the end. An Axpy becomes two layers.
OpenCV: modules/dnn/src/caffe/caffe_importer.cpp (4.12)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

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


def outputs(net: NetParameter) -> dict[tuple[int, int], str]:
    """Return the blobs that no layer reads after the last one that writes them, by layer and index of the top."""
    found: dict[str, tuple[int, int]] = {}
    for i, layer in enumerate(net.layer):
        for blob in layer.bottom:
            found.pop(blob, None)
        found.update({blob: (i, j) for j, blob in enumerate(layer.top)})
    return {top: blob for blob, top in found.items()}


def unconnected(net: NetParameter, table: Sequence[Entry]) -> list[int]:
    """Return the numbers of the layers whose tops no other layer reads."""
    unread = outputs(net)
    inputs = [i for i, layer in enumerate(net.layer) if layer.type == "Input"]
    found = []
    for number, entry in enumerate(table):
        tops = [(i, j) for i in (inputs if number == 0 else [entry.layer]) for j in range(len(net.layer[i].top))]
        if entry.type == "Convolution":
            tops = [(entry.layer, entry.top)]
        is_half = number > 0 and entry.top < 0 and bool(tops)  # of an Axpy, which the other half reads
        if not is_half and all(top in unread for top in tops):
            found.append(number)
    return found


def nodes_of(plan: Plan, net: NetParameter) -> list[int]:
    """Return for each layer of the filtered net its node in the plan, which also has Split layers."""
    nodes: list[int] = []
    for i, node in enumerate(plan.nodes):
        layer = net.layer[len(nodes)] if len(nodes) < len(net.layer) else None
        if layer is not None and (node.name, node.type) == (layer.name, layer.type):
            nodes.append(i)
    return nodes
