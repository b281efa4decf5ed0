"""Makes the layers of a plan, first their shapes, then their memory, and determines which layers run backward.

All layers are made before any blob has memory, so a net that needs too much is refused before it takes any.

Caffe: Net::Init (src/caffe/net.cpp). Names such as net.cpp:124 in the log calls are the lines of that file that
print the same.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from google.protobuf.message import Message

from netspec import log
from netspec.errors import Code, Report, SpecError, Where
from netspec.files.limits import LIMIT, amount, is_out_of_memory, memory, read_amount
from netspec.graph.options import BuildOptions
from netspec.graph.plan import AUTOMATIC, Backward, Node, Param, Plan, plan_backward, unblocked
from netspec.layers import unknown_type
from netspec.layers.contract.base import Layer, Shape, shape_string
from netspec.layers.contract.context import Context, Random, device_of
from netspec.layers.contract.data_layer import DataLayer
from netspec.layers.contract.fillers import READS
from netspec.layers.contract.registry import registered
from netspec.net.frozen import compute_caffes_gradients, needs_backward
from netspec.proto.schema import TEST

BYTES = 4  # of a number: float32

#: Fields that every layer has and that the net reads, not the layer.
COMMON = frozenset(
    {"name", "type", "bottom", "top", "phase", "loss_weight", "param", "blobs", "propagate_down", "include", "exclude"}
)
#: Fields that only choose an implementation in Caffe, so results do not depend on them.
WITHOUT_EFFECT = frozenset({"engine", "force_nd_im2col", "share_in_parallel", "stable_prod_grad"})

_FieldPath = tuple[str, ...]  # the names from the layer's field to the field inside it


@dataclass(frozen=True)
class Learnable:
    """A learnable blob with the layer that owns it, its index there, and its multipliers."""

    parameter: torch.nn.Parameter
    lr_mult: float
    decay_mult: float
    layer: str
    index: int


class Assembly:
    """The layers of a plan, and what the net needs to run them.

    ``layers[i]`` belongs to node i. If errors are collected rather than raised, faulty layers are missing. ``shapes``
    has the shape of each blob, and ``loss_weights[i][j]`` is the loss weight of top j of layer i. ``backward`` says
    which layers need backward computation; it is None if a layer is missing. ``options`` are the given options, with
    the dialects of the net added.
    """

    def __init__(self, plan: Plan, options: BuildOptions) -> None:
        self.options = replace(options, dialects=plan.meaning.dialects)
        self.plan = plan
        self._report = plan.source.report
        self.layers: dict[int, Layer] = {}
        self.shapes: dict[str, Shape] = {}
        self.loss_weights: list[list[float]] = []
        self.learnable: list[Learnable] = []  # a shared blob is there once
        self.need = MemoryNeed(plan)
        self.backward: Backward | None = None
        self.random = Random(int.from_bytes(os.urandom(4), "little") if options.seed is None else options.seed)
        device = device_of(options.device)
        on_meta = device.type == "meta"
        self._values: dict[int, Shape] = {}
        self._memory = 0  # as Caffe counts it
        self._shared: dict[tuple[int, int], tuple[int, int]] = {}  # (layer, blob) -> those of the owner of its memory
        for i in range(len(plan.nodes)):
            if layer := self._make_layer(i):
                self._set_up(i, layer)
        fault = None if on_meta else self.need.fault(limit_on(device, options.limit))
        if fault:
            self._report(fault)
        for i, layer in self.layers.items() if not fault else ():
            self._allocate(i, layer)
        if len(self.layers) == len(plan.nodes):
            self.backward = self._finish(list(self.layers.values()))

    def _make_layer(self, i: int) -> Layer | None:
        """Return layer ``i``, or None if it or a layer that it depends on has a fault. The fault is reported."""
        node, param = self.plan.nodes[i], self.plan.net.layer[i]
        this = _LayerInNet(self.plan, i)
        log.info("layer_factory.hpp:77", f"Creating layer {node.name}")
        cls = self.plan.meaning.classes.get(i) or registered(node.type)
        if cls is None and i in self.plan.meaning.classes:
            return None  # the fault was reported
        if cls is None:
            self._report(SpecError(unknown_type(node.type), this.at("type"), Code.UNKNOWN_TYPE, (node.type,)))
            return None
        if any(v not in self._values for v in node.bottoms):
            return None  # an error upstream was reported
        phase = self.plan.net.state.phase
        fork = self.plan.meaning.forks.get(i, "")
        context = Context(phase, self.options, self.random, this.at, self._report, this.created, False, fork)
        try:
            layer = cls(param, [self._values[v] for v in node.bottoms], context)
        except SpecError as fault:
            self._report(fault)
            return None
        except (MemoryError, RuntimeError) as fault:
            raise self._out_of_memory(i, fault) from None
        return layer

    def _set_up(self, i: int, layer: Layer) -> None:
        """Record and log the tops of layer ``i``, and connect its parameters."""
        node = self.plan.nodes[i]
        weights = _loss_weights(layer, self._report)
        self.layers[i] = layer
        self.loss_weights.append(weights)
        for v, shape in zip(node.tops, layer.top_shapes, strict=False):
            self._values[v] = shape
            self.shapes[self.plan.blobs[v]] = shape
        log.info("net.cpp:124", f"Setting up {node.name}")
        for shape, weight in zip(layer.top_shapes, weights, strict=True):
            self._memory += math.prod(shape) * 4
            log.info("net.cpp:131", "Top shape: " + shape_string(shape))
            if weight:
                log.info("net.cpp:134", f"    with loss weight {log.number(weight)}")
        log.info("net.cpp:139", f"Memory required for data: {self._memory}")
        self.need.add(i, layer, self._check_params(i, layer))

    def _check_params(self, i: int, layer: Layer) -> int:
        """Report wrong params of layer ``i``, log which are shared, and return the bytes of the others."""
        node = self.plan.nodes[i]
        if len(node.params) > len(layer.blobs):
            message = f"found {len(node.params)} param {{ }}, expected at most {len(layer.blobs)}, one per blob"
            self._report(layer.error(message, "param", len(layer.blobs)))
        owned = 0
        for j, here in enumerate(layer.blob_shapes):
            spec = _spec(node, layer, j)
            if spec.owner is None:
                owned += BYTES * math.prod(here)
                continue
            owner = self.layers.get(spec.owner[0])  # None: an error in it was reported, as too many param { } were
            if owner is None or spec.owner[1] >= len(owner.blobs):
                continue
            there = owner.blob_shapes[spec.owner[1]]
            owner_name = self.plan.nodes[spec.owner[0]].name
            if math.prod(here) == math.prod(there) if spec.permissive else here == there:
                self._shared[i, j] = spec.owner
                owner = f"owned by layer '{owner_name}', param index {spec.owner[1]}"
                log.info("net.cpp:467", f"Sharing parameters '{spec.name}' {owner}")
                continue
            rule = "equal counts" if spec.permissive else "equal shapes (share_mode: STRICT)"
            message = (
                f'cannot share param "{spec.name}" owned by layer "{owner_name}", param index {spec.owner[1]}: '
                f"found shape {shape_string(here)} here and {shape_string(there)} there, expected {rule}"
            )
            self._report(layer.error(message, "param", j))
        return owned

    def _allocate(self, i: int, layer: Layer) -> None:
        """Give the blobs of layer ``i`` their memory: that of the owner, if shared. The others are learnable."""
        node = self.plan.nodes[i]
        try:
            layer.allocate()
        except (MemoryError, RuntimeError) as fault:
            raise self._out_of_memory(i, fault) from None
        for j in range(len(layer.blobs)):
            spec = _spec(node, layer, j)
            if spec.owner is None:
                parameter = layer.blobs[j]
                parameter.requires_grad_(spec.lr_mult != 0 or self.plan.net.force_backward)
                self.learnable.append(Learnable(parameter, spec.lr_mult, spec.decay_mult, node.name, j))
            elif (i, j) in self._shared:
                owner, of_owner = self._shared[i, j]
                layer.blobs[j] = self.layers[owner].blobs[of_owner]

    def _out_of_memory(self, i: int, fault: BaseException) -> BaseException:
        """Return the error for a layer that got no memory; any other error is returned unchanged."""
        if not is_out_of_memory(fault):
            return fault
        message = f"its blobs need more memory than available: this machine has {amount(memory())}"
        return SpecError(message, _LayerInNet(self.plan, i).at())

    def _finish(self, layers: list[Layer]) -> Backward:
        """Return which layers need backward computation, by Caffe's rules. Log the end of Caffe's Net::Init."""
        learns = [needs_backward(self.plan, i, layer) for i, layer in enumerate(layers)]
        has_loss = [[bool(w) for w in weights] for weights in self.loss_weights]
        labels = [layer.label_bottoms for layer in layers]
        ignoring = [layer.ignores_propagate_down for layer in layers]
        backward = plan_backward(self.plan, learns, has_loss, labels, ignoring)
        self.plan = unblocked(self.plan, backward)
        if self.options.accumulate_in_place:
            compute_caffes_gradients(self.plan, layers, backward)
        for node, needs in zip(reversed(self.plan.nodes), reversed(backward.layers), strict=True):
            if needs:
                log.info("net.cpp:200", f"{node.name} needs backward computation.")
            else:
                log.info("net.cpp:202", f"{node.name} does not need backward computation.")
        for name in self.plan.outputs:
            log.info("net.cpp:244", f"This network produces output {name}")
        log.info("net.cpp:257", "Network initialization done.")
        for line in (*self.plan.meaning.warnings, *unused_fields(self.plan, layers)):
            log.warning("net.cpp:257", line)
        return backward


class _LayerInNet:
    """What layer ``i`` must know about its net: its position in the file, and its blobs for the log.

    The class has slots and no reference to the Assembly, because a net may have very many layers.
    """

    __slots__ = ("_i", "_plan")

    def __init__(self, plan: Plan, i: int) -> None:
        self._plan, self._i = plan, i

    def at(self, *path: str | int) -> Where:
        """Return the position in the prototxt of a field of the layer."""
        node = self._plan.nodes[self._i]
        return self._plan.source.at(self._i, *path, layer=node.name, type=node.type)

    def created(self, tops: int) -> None:
        """Log the layer's bottoms and tops. ``tops`` may be more than the prototxt names: a loss adds one."""
        node, blobs = self._plan.nodes[self._i], self._plan.blobs
        log.info("net.cpp:86", f"Creating Layer {node.name}")
        for v in node.bottoms:
            log.info("net.cpp:408", f"{node.name} <- {blobs[v]}")
        for v, in_place in zip(node.tops, node.in_place, strict=True):
            if in_place:
                log.info("net.cpp:369", f"{node.name} -> {blobs[v]} (in-place)")
            else:
                log.info("net.cpp:382", f"{node.name} -> {blobs[v]}")
        for _ in range(len(node.tops), tops):
            log.info("net.cpp:382", f"{node.name} -> {AUTOMATIC}")


def _spec(node: Node, layer: Layer, j: int) -> Param:
    """Return the settings of learnable blob ``j``, from the prototxt or the layer."""
    return layer.param_spec(j, node.params[j] if j < len(node.params) else None)


def _loss_weights(layer: Layer, report: Report) -> list[float]:
    """Return the loss weight of each top (Caffe: Layer::SetLossWeights, LossLayer::LayerSetUp)."""
    given = list(layer.param.loss_weight)
    if given:
        if len(given) == layer.num_tops:
            return given
        message = f"found {len(given)} loss_weight, expected none or one per top blob ({layer.num_tops})"
        report(layer.error(message, "loss_weight"))
    return [layer.default_loss_weight if j == 0 else 0.0 for j in range(layer.num_tops)]


# Memory


class MemoryNeed:
    """The least memory that a net needs, in bytes, as far as the shapes of its layers are known.

    ``parameters`` counts a shared parameter once. ``tops`` is the peak memory of the tops: in phase TEST a top is freed
    after its last use; in phase TRAIN all tops are needed for the backward computation. A top that is computed in
    place, or that shares the memory of its bottom, needs none. ``ahead`` is the memory of batches that data layers read
    ahead. Gradients, the solver's history and the work memory of kernels are not counted.
    """

    def __init__(self, plan: Plan) -> None:
        self.parameters = self.tops = self.ahead = 0
        self._plan = plan
        self._ends = plan.ends if plan.net.state.phase == TEST else [()] * len(plan.nodes)
        self._home: dict[int, int] = {}  # value -> the value that owns its memory
        self._sizes: dict[int, int] = {}
        self._users: dict[int, int] = {}  # how many values that are still needed are in the memory of a value
        self._alive = 0
        self._largest = (0, 0)  # bytes of the layer that needs most, and minus its index, so that the first one wins

    @property
    def total(self) -> int:
        """The sum of the three, in bytes."""
        return self.parameters + self.tops + self.ahead

    def add(self, i: int, layer: Layer, parameters: int) -> None:
        """Add layer ``i`` and its ``parameters`` bytes. Layers must be added in order."""
        node, made = self._plan.nodes[i], 0
        for j, (v, shape) in enumerate(zip(node.tops, layer.top_shapes, strict=False)):
            bottom = node.bottoms[j if node.in_place[j] else 0] if node.bottoms else -1
            shared = node.in_place[j] or "data" in layer.shares
            home = self._home.get(bottom, v) if shared else v
            if home == v:
                self._sizes[v] = BYTES * math.prod(shape)
                made += self._sizes[v]
            self._home[v] = home
            self._users[home] = self._users.get(home, 0) + 1
        self._alive += made
        self.tops = max(self.tops, self._alive)
        self.parameters += parameters
        ahead = layer.ahead if isinstance(layer, DataLayer) else 0
        self.ahead += ahead
        self._largest = max(self._largest, (made + parameters + ahead, -i))
        for v in self._ends[i]:
            home = self._home.pop(v, None)
            if home is not None:
                self._users[home] -= 1
                self._alive -= 0 if self._users[home] else self._sizes.pop(home)

    def fault(self, limit: int) -> SpecError | None:
        """Return an error that names the layer that needs most, or None if ``limit`` bytes are enough."""
        if self.total <= limit:
            return None
        size, i = self._largest[0], -self._largest[1]
        node = self._plan.nodes[i]
        return SpecError(
            f"needs {amount(size)} of memory, more than any other layer; "
            f"the net needs at least {self}; {limit_text(limit)}",
            self._plan.source.at(i, layer=node.name, type=node.type),
        )

    def __str__(self) -> str:
        """Return the need as text for a message."""
        ahead = f", batches read ahead {amount(self.ahead)}" if self.ahead else ""
        return f"{amount(self.total)}: parameters {amount(self.parameters)}, tops {amount(self.tops)}{ahead}"


def limit_on(device: torch.device, limit: int | None = None) -> int:
    """Return how many bytes a net may need on a device: ``limit`` if given, or that of the process, or the device's.

    Raises SpecError if that of the process is no size.
    """
    if limit is not None:
        return limit
    if given := os.environ.get(LIMIT):
        try:
            return read_amount(given)
        except ValueError as fault:
            raise SpecError(str(fault), Where(LIMIT)) from None
    return torch.cuda.mem_get_info(device)[1] if device.type == "cuda" else memory()


def limit_text(limit: int) -> str:
    """Return the part of a message that states the limit and how to change it."""
    return f"the limit is {amount(limit)}; change it with --limit SIZE"


# Warnings


def unused_fields(plan: Plan, layers: Iterable[Layer]) -> Iterator[str]:
    """Yield a warning for each field that has no effect: its first position in the file, and the number of others."""
    found: dict[tuple[str, _FieldPath, str], list[int]] = {}
    for i, layer in enumerate(layers):
        for path, reason in _unused(layer):
            found.setdefault((layer.type, path, reason), []).append(i)
    for (kind, path, reason), positions in found.items():
        first = positions[0]
        where = plan.source.at(first, *path, layer=plan.nodes[first].name, type=kind)
        others = f" (also in {len(positions) - 1} more of these layers)" if len(positions) > 1 else ""
        yield f"{where}: {'.'.join(path)} has no effect: {reason}{others}"
    for field, _ in plan.net.ListFields():
        if field.is_extension or field.name == "debug_info":
            advice = "; set it in the solver" if field.name == "debug_info" else ""
            yield f"{plan.source.net.find(field.name)}: {field.name} has no effect in a net{advice}"


def _unused(layer: Layer) -> Iterator[tuple[_FieldPath, str]]:
    """Yield each field of a layer that it does not read, with the reason to print."""
    partly = {name.partition(".")[0] for name in layer.reads if "." in name}
    for field, value in layer.param.ListFields():
        if field.name in COMMON or field.name in WITHOUT_EFFECT:
            continue
        if field.name not in layer.reads | partly:
            yield (field.name,), f"a layer of type {layer.type} does not read it"
            continue
        if field.message_type is None:
            continue
        whole = field.name in layer.reads
        for inner, inner_value in value.ListFields():
            path = f"{field.name}.{inner.name}"
            known = (whole and not inner.is_extension and path not in layer.ignores) or path in layer.reads
            if not known and inner.name not in WITHOUT_EFFECT:
                yield (field.name, inner.name), f"a layer of type {layer.type} does not read it"
            elif inner.message_type is not None and inner.message_type.full_name == "caffe.FillerParameter":
                for filler in [inner_value] if isinstance(inner_value, Message) else inner_value:
                    for name, reason in _unused_of_filler(filler):
                        yield (field.name, inner.name, name), reason


def _unused_of_filler(filler: Any) -> Iterator[tuple[str, str]]:
    for field, _ in filler.ListFields():
        if field.name != "type" and field.name not in READS.get(filler.type, ()):
            yield field.name, f'filler "{filler.type}" does not read it'
