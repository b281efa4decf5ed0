"""Computes the diagram of a net: layers as boxes, blobs as lines, with shapes and costs.

Both phases are in one diagram. An in-place layer is drawn in the box of the layer that computed the blob, unless
another layer reads the blob before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Declared

from netspec import log
from netspec.data.blobs import Shape
from netspec.errors import SpecError, Where
from netspec.graph.filter import filter_net, with_state
from netspec.graph.options import BuildOptions
from netspec.graph.plan import Node, Plan, make_plan
from netspec.layers import Layer, layer_class
from netspec.net.build import build_filtered
from netspec.proto.schema import PHASE_NAMES, NetParameter, PhaseValue, copy_without, given
from netspec.proto.source_map import Position, SourceMap
from netspec.proto.text import write_text
from netspec.proto.writer import scalar_text

MOST_SETTINGS = 6  # that are shown
OWN = "_param"  # the ending of fields with a layer's own settings
COMMON = ("loss_param", "transform_param")  # fields with this ending that many layers have
NOT_SHOWN = ("engine", "bias_term", "axis", "source", "backend", "root_folder", "mean_file", "prefetch", "rand_skip")
WINDOWS = {"kernel_size": ("kernel_h", "kernel_w"), "stride": ("stride_h", "stride_w"), "pad": ("pad_h", "pad_w")}
DEFAULTS = {"kernel_size": "0", "stride": "1", "pad": "0"}
NOT_SHOWN_VALUES = (("group", "1"), ("dilation", "1"))


def settings_text(layer: Any) -> str:
    """Return the layer's own settings in the prototxt, without inner messages (fillers, lists of shapes)."""
    words: list[str] = []
    for field in given(layer):
        if field.name.endswith(OWN) and field.name not in COMMON and not field.repeated:
            words += _words(field.get(layer))
    return ", ".join(words[:MOST_SETTINGS])


def _words(param: Any) -> Iterator[str]:
    shown = {
        field.name: _value(field, field.get(param))
        for field in given(param)
        if field.type != Declared.TYPE_MESSAGE and field.name not in NOT_SHOWN
    }
    for name, (high, wide) in WINDOWS.items():
        sizes = shown[name].split("×") if name in shown else [shown.pop(side, DEFAULTS[name]) for side in (high, wide)]
        shown.pop(name, None)
        if set(sizes) == {DEFAULTS[name]}:
            continue
        if len(set(sizes)) > 1:
            shown[name] = "×".join(sizes)
        else:
            shown[name] = f"{sizes[0]}×{sizes[0]}" if name == "kernel_size" else sizes[0]
    for name in ("kernel_size", "num_output", "pool"):
        if name in shown:
            yield shown.pop(name)
    for name, value in shown.items():
        if value == "true":
            yield name.replace("_", " ")
        elif (name, value) not in NOT_SHOWN_VALUES:
            yield f"{name.replace('_', ' ')} {value}" if not value.isupper() else value


def _value(field: Any, value: Any) -> str:
    values = list(value) if field.repeated else [value]
    separator = "×" if field.name in WINDOWS else " "
    return separator.join(each if isinstance(each, str) else scalar_text(field, each) for each in values)


Output = tuple[int, int]  # a box, and the index of its top


@dataclass(frozen=True)
class Attached:
    """An in-place layer, drawn in the box of the layer that computed its blob.

    ``kind`` is the module of netspec.layers that defines it. ``phases`` are the phases that have it, or empty if all
    drawn phases do.
    """

    name: str
    type: str
    kind: str
    settings: str
    phases: tuple[str, ...]


@dataclass(frozen=True)
class Box(Attached):
    """A layer in the diagram.

    ``weights`` is the number of its own weights; ``owner`` is the layer that it shares parameters with. ``work`` is its
    multiply-adds in one forward pass. ``text`` is its prototxt and that of the attached layers. ``same`` is equal for
    layers that differ only in names.
    """

    where: Where
    text: str
    same: str
    weights: int = 0
    owner: str = ""
    work: int = 0
    attached: tuple[Attached, ...] = ()
    shapes: tuple[str, ...] = ()  # of its tops


@dataclass(frozen=True)
class Diagram:
    """The boxes in the order of the net, and the outputs that each reads, in the order of its bottoms.

    ``faults`` are the errors in parts of the net that could not be built. Shapes and costs are missing there.
    """

    name: str
    boxes: tuple[Box, ...]
    reads: tuple[tuple[Output, ...], ...]
    tops: tuple[tuple[str, ...], ...]
    faults: tuple[SpecError, ...] = ()


@dataclass
class _NetInPhase:
    """A net in one phase. Layer ``i`` of the plan is layer ``numbers[i]`` of the file."""

    phase: str
    plan: Plan
    numbers: list[int]
    layers: Mapping[int, Layer]  # the layers that were built, by their index in the file


def diagram_of(
    net: NetParameter, source: SourceMap, phases: Sequence[PhaseValue], options: BuildOptions | None = None
) -> Diagram:
    """Return the diagram of an upgraded net in the given phases. Writes no file and allocates no blobs."""
    faults: list[SpecError] = []
    options = replace(options or BuildOptions(open_data=False), device="meta", seed=0, write_files=False, passes=())
    with log.silent():
        source = source.reporting_to(faults.append)
        seen = [
            _net_in_phase(with_state(net, phase, options.level, options.stages), source, PHASE_NAMES[phase], options)
            for phase in phases
        ]
    return _merged(net, source, seen, tuple({str(fault): fault for fault in faults}.values()))


def _net_in_phase(net: NetParameter, source: SourceMap, phase: str, options: BuildOptions) -> _NetInPhase:
    """Filter, plan and build a net in its state."""
    numbered = source.with_layers(Position(Where(str(k))) for k in range(len(net.layer)))
    filtered, numbers = filter_net(net, numbered)
    numbers = [int(layer.where.file) for layer in numbers.layers]
    placed = source.with_layers(source.layers[k] for k in numbers)
    # The build, which plans again with splits, reports errors in the connections.
    plan = make_plan(filtered, placed.reporting_to(lambda fault: None))
    waiting: dict[str, list[int]] = {}
    for number, layer in zip(numbers, filtered.layer, strict=True):
        waiting.setdefault(layer.name, []).append(number)
    layers: dict[int, Layer] = {}
    try:
        built: Sequence[Any] = list(build_filtered(filtered, placed, options).layers)
    except SpecError as fault:
        source.report(fault)
        built = ()
    for layer in built:
        if waiting.get(layer.param.name):  # the others are Split layers
            layers[waiting[layer.param.name].pop(0)] = layer
    return _NetInPhase(phase, plan, numbers, layers)


def _merged(
    net: NetParameter, source: SourceMap, seen: Sequence[_NetInPhase], faults: tuple[SpecError, ...]
) -> Diagram:
    """Return one diagram of all phases."""
    phases_of: dict[int, list[str]] = {}
    boxed: set[int] = set()  # layers with a separate box in some phase
    for one in seen:
        for number in one.numbers:
            phases_of.setdefault(number, []).append(one.phase)
        boxed.update(number for number, alone in zip(one.numbers, _alone(one.plan), strict=True) if alone)
    index = {number: k for k, number in enumerate(sorted(boxed))}
    reads: list[list[Output]] = [[] for _ in index]
    attached: list[dict[int, None]] = [{} for _ in index]
    for one in seen:
        origin: dict[int, Output] = {}
        for number, node in zip(one.numbers, one.plan.nodes, strict=True):
            sources = [origin[v] for v in node.bottoms if v in origin]
            if number not in index:
                origin[node.tops[0]] = sources[0]
                attached[sources[0][0]][number] = None
                continue
            k = index[number]
            reads[k] += [output for output in sources if output not in reads[k]]
            origin.update({v: (k, j) for j, v in enumerate(node.tops)})
    drawn = [one.phase for one in seen]

    def described(number: int) -> tuple[str, str, str, str, tuple[str, ...]]:
        layer = net.layer[number]
        phases = () if phases_of[number] == drawn else tuple(phases_of[number])
        return layer.name, layer.type, kind_of(layer.type), settings_text(layer), phases

    boxes = []
    for number, k in index.items():
        name, type_name, *_ = own = described(number)
        numbers = [number, *sorted(attached[k])]
        others = tuple(Attached(*described(m)) for m in numbers[1:])
        text = "".join(_text(net.layer[m]) for m in numbers)
        phases = own[-1], *(other.phases for other in others)
        same = "\n".join(f"{p}{_without_names(net.layer[m])}" for m, p in zip(numbers, phases, strict=True))
        box = Box(*own, source.at(number, layer=name, type=type_name), text, same, attached=others)
        boxes.append(_with_costs(box, numbers, seen, len(net.layer[number].top)))
    tops = tuple(tuple(net.layer[number].top) for number in index)
    return Diagram(net.name, tuple(boxes), tuple(map(tuple, reads)), tops, faults)


def _alone(plan: Plan) -> list[bool]:
    """Return for each layer whether it has a separate box.

    It has none if it computes in place, is the only reader of its bottom, and its bottom is the only top of its layer.
    """
    readers = [0] * len(plan.blobs)
    maker: dict[int, int] = {}
    for node in plan.nodes:
        for v in node.bottoms:
            if v >= 0:
                readers[v] += 1
    alone = []
    for i, node in enumerate(plan.nodes):
        inside = node.in_place == (True,) and len(node.bottoms) == 1 and node.bottoms[0] in maker
        inside = inside and readers[node.bottoms[0]] == 1 and len(plan.nodes[maker[node.bottoms[0]]].tops) == 1
        alone.append(not inside)
        maker.update(dict.fromkeys(node.tops, i))
    return alone


def _with_costs(box: Box, numbers: Sequence[int], seen: Sequence[_NetInPhase], tops: int) -> Box:
    """Return the box with shapes, weights and work. If phases differ, the work is that of the first."""
    shapes: list[list[Shape]] = [[] for _ in range(tops)]
    work, weights, owner = 0, 0, ""
    for one in reversed(seen):
        nodes = {number: one.plan.nodes[one.numbers.index(number)] for number in numbers if number in one.numbers}
        owners = [one.plan.nodes[param.owner[0]].name for n in nodes.values() for param in n.params if param.owner]
        owner = owners[0] if owners else owner
        layers = {number: one.layers[number] for number in nodes if number in one.layers}
        for j, shape in enumerate(layers[numbers[0]].top_shapes[:tops] if numbers[0] in layers else ()):
            shapes[j].insert(0, tuple(shape))
        if layers:
            work = sum(layer.multiply_adds() for layer in layers.values())
            weights = sum(_own_weights(nodes[number], layer) for number, layer in layers.items())
    return replace(box, shapes=tuple(map(_shape_text, shapes)), work=work, weights=weights, owner=owner)


def _own_weights(node: Node, layer: Layer) -> int:
    shared = {j for j, param in enumerate(node.params) if param.owner}
    return sum(math.prod(shape) for j, shape in enumerate(layer.blob_shapes) if j not in shared)


def _shape_text(shapes: Sequence[Shape]) -> str:
    """Return ``64×1×28×28``, or ``64|100×1×28×28`` if the phases differ, or "" if it is unknown."""
    if not shapes:
        return ""
    if len({len(shape) for shape in shapes}) > 1:
        return " | ".join(dict.fromkeys(map(_one_shape, shapes)))
    return _one_shape(["|".join(dict.fromkeys(map(str, sizes))) for sizes in zip(*shapes, strict=True)])


def _one_shape(sizes: Sequence[object]) -> str:
    return "×".join(map(str, sizes)) or "scalar"


def kind_of(type_name: str) -> str:
    """Return the module of netspec.layers that defines a type, e.g. "vision.convolution"; "dialect"; or ""."""
    cls = layer_class(type_name)
    if cls is None:
        return ""
    package, _, module = cls.__module__.removeprefix("netspec.").partition(".")
    return module if package == "layers" else "dialect"


def _text(layer: Any) -> str:
    return "layer {\n" + "".join(f"  {line}\n" for line in write_text(layer).splitlines()) + "}\n"


def _without_names(layer: Any) -> str:
    """Return a layer's prototxt without the names of the layer, its blobs and its parameters."""
    bare = copy_without(layer, ("name", "bottom", "top", "blobs"))
    for param in bare.param:
        param.name = "shared" if param.name else ""
    return write_text(bare)
