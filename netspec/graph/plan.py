"""The execution plan of a net: the values that each layer reads and writes, the owners of parameters, the outputs.

Blob *names* are Caffe's; *values* are numbered, one for each write of a layer. An in-place layer writes a new value
under an old name, so a Plan has no in-place operations and each value is written once.
Caffe: Net::Init, AppendTop, AppendBottom, AppendParam (src/caffe/net.cpp).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from netspec.errors import SpecError
from netspec.proto.forks import Meaning
from netspec.proto.schema import NetParameter
from netspec.proto.source_map import SourceMap

AUTOMATIC = "(automatic)"  # the name of a loss's top without a name
PERMISSIVE = 1  # caffe.proto: ParamSpec.DimCheckMode


@dataclass(frozen=True)
class Param:
    """One ``param { }`` of a layer. ``owner``: (layer, index) of the parameter that it shares, if any."""

    name: str
    lr_mult: float
    decay_mult: float
    permissive: bool
    owner: tuple[int, int] | None


@dataclass(frozen=True)
class Node:
    """One layer: ``bottoms`` and ``tops`` are value numbers (-1 for a bottom that no layer writes)."""

    name: str
    type: str
    bottoms: tuple[int, ...]
    tops: tuple[int, ...]
    in_place: tuple[bool, ...]
    params: tuple[Param, ...]
    blocked: tuple[bool, ...]  # propagate_down: false, by bottom; see also unblocked()


@dataclass(frozen=True)
class Plan:
    """A net in execution order.

    ``blobs[v]`` is the name of value ``v``; ``outputs`` maps names, in Caffe's order, to values;
    ``final[v]`` is the value that finally replaces ``v`` in Caffe's memory, from the last in-place layer.
    ``ends[i]`` are the values that are no longer needed once node ``i`` has run.
    ``meaning`` is what the forks of Caffe say that the net means (``Forks.meaning``).
    """

    net: NetParameter
    source: SourceMap
    nodes: tuple[Node, ...]
    blobs: tuple[str, ...]
    outputs: dict[str, int]
    final: tuple[int, ...]
    ends: tuple[tuple[int, ...], ...]
    meaning: Meaning


def make_plan(net: NetParameter, source: SourceMap, meaning: Meaning | None = None) -> Plan:
    """Return the Plan of a filtered net with its splits."""
    blobs: list[str] = []
    current: dict[str, int] = {}
    available: set[str] = set()
    owners: dict[str, tuple[int, int]] = {}
    multipliers = _shared_multipliers(net, source)
    nodes = []

    def report(i: int, message: str, *path: str | int) -> None:
        layer = net.layer[i]
        source.report(SpecError(message, source.at(i, *path, layer=layer.name, type=layer.type)))

    for i, layer in enumerate(net.layer):
        propagate = list(layer.propagate_down) or [True] * len(layer.bottom)
        if len(propagate) != len(layer.bottom):
            message = f"found {len(layer.propagate_down)} propagate_down, expected 0 or {len(layer.bottom)}"
            report(i, message, "propagate_down")
            propagate = [True] * len(layer.bottom)
        bottoms = tuple(current.get(blob, -1) for blob in layer.bottom)
        available.difference_update(layer.bottom)
        tops, in_place = [], []
        for j, blob in enumerate(layer.top):
            replaces = j < len(layer.bottom) and layer.bottom[j] == blob
            if blob in current and not replaces:
                first = next(k for k, other in enumerate(net.layer) if blob in other.top)
                report(
                    i,
                    f'top blob "{blob}" is produced by multiple sources (first by layer "{net.layer[first].name}"); '
                    "rename one, or compute in place: same bottom and top, before its other uses",
                    "top",
                    j,
                )
            in_place.append(replaces)
            tops.append(len(blobs))
            current[blob] = len(blobs)
            blobs.append(blob)
            available.add(blob)
        params = []
        for j, spec in enumerate(layer.param):
            lr_mult, decay_mult = spec.lr_mult, spec.decay_mult
            owner = None
            if spec.name:
                owner = owners.setdefault(spec.name, (i, j))
                owner = None if owner == (i, j) else owner
                lr_mult, decay_mult = multipliers[spec.name]
            params.append(Param(spec.name, lr_mult, decay_mult, spec.share_mode == PERMISSIVE, owner))
        blocked = tuple(not down for down in propagate)
        nodes.append(Node(layer.name, layer.type, bottoms, tuple(tops), tuple(in_place), tuple(params), blocked))
    outputs = {name: current[name] for name in sorted(available)}
    final = _last_values(nodes, len(blobs))
    meaning = meaning or Meaning(net)
    return Plan(net, source, tuple(nodes), tuple(blobs), outputs, final, last_uses(nodes), meaning)


def _last_values(nodes: Sequence[Node], count: int) -> tuple[int, ...]:
    """Return, for each value, the value in its memory after all in-place layers."""
    final = list(range(count))
    for node in reversed(nodes):
        for j, replaces in enumerate(node.in_place):
            if replaces and node.bottoms[j] >= 0:
                final[node.bottoms[j]] = final[node.tops[j]]
    return tuple(final)


def last_uses(steps: Sequence[Any]) -> tuple[tuple[int, ...], ...]:
    """Return, by node or other step with ``tops`` and ``bottoms``, the values that no later one reads."""
    last = {v: i for i, step in enumerate(steps) for v in (*step.tops, *step.bottoms)}
    ends: list[list[int]] = [[] for _ in steps]
    for v, i in last.items():
        ends[i].append(v)
    return tuple(map(tuple, ends))


def _shared_multipliers(net: NetParameter, source: SourceMap) -> dict[str, tuple[float, float]]:
    """Return lr_mult and decay_mult of each parameter name; if they are given several times, they must be equal."""
    found: dict[str, dict[str, float]] = {}
    for i, layer in enumerate(net.layer):
        for j, spec in enumerate(layer.param):
            if not spec.name:
                continue
            given = found.setdefault(spec.name, {})
            for field in ("lr_mult", "decay_mult"):
                if not spec.HasField(field):
                    continue
                value = getattr(spec, field)
                if given.setdefault(field, value) != value:
                    where = source.at(i, "param", j, field, layer=layer.name, type=layer.type)
                    message = f'shared param "{spec.name}" has {field} {value:g} here and {given[field]:g} before'
                    source.report(SpecError(message, where))
    return {name: (given.get("lr_mult", 1.0), given.get("decay_mult", 1.0)) for name, given in found.items()}


@dataclass(frozen=True)
class Backward:
    """Where Caffe computes gradients: ``layers[i]``, whether layer i does, and ``bottoms[i][j]``, for which bottoms.

    ``written`` is ``bottoms`` with those added that get a gradient because their layer ignores propagate_down.
    ``computed`` is ``written`` without those added whose gradient nobody reads.
    """

    layers: tuple[bool, ...]
    bottoms: tuple[tuple[bool, ...], ...]
    computed: tuple[tuple[bool, ...], ...]
    written: tuple[tuple[bool, ...], ...]


def plan_backward(
    plan: Plan,
    learns: Sequence[bool],
    has_loss: Sequence[Sequence[bool]],
    label_bottoms: Sequence[frozenset[int]],
    ignoring: Sequence[frozenset[int]],
) -> Backward:
    """Decide what needs backward computation, like Net::Init.

    ``learns[i]``: layer i has a parameter with a nonzero rate; ``has_loss[i][j]``: its top j has a loss weight (also
    anonymous tops); ``label_bottoms[i]``: its bottoms that never receive a gradient; ``ignoring[i]``: its bottoms that
    receive one even with ``propagate_down: false``, which matters if the layer that computes them has a backward pass.
    """
    value_needs = [False] * len(plan.blobs)
    layer_needs: list[bool] = []
    bottom_needs: list[list[bool]] = []
    for i, node in enumerate(plan.nodes):
        wanted = [v >= 0 and value_needs[v] for v in node.bottoms]
        declared = list(plan.net.layer[i].propagate_down)
        bottom_needs.append(declared if len(declared) == len(wanted) and declared else list(wanted))
        needs = any(wanted) or learns[i]
        layer_needs.append(needs)
        for v in node.tops:
            value_needs[v] = needs
    under_loss: set[str] = set()
    skipped: set[str] = set()
    for i in reversed(range(len(plan.nodes))):
        node = plan.nodes[i]
        names = [plan.blobs[v] for v in node.tops]
        names += [AUTOMATIC] * (len(has_loss[i]) - len(names))
        contributes = any(has_loss[i]) or any(name in under_loss for name in names)
        if layer_needs[i] and all(name in skipped for name in names):
            layer_needs[i] = False
            bottom_needs[i] = [False] * len(node.bottoms)
        if not contributes:
            layer_needs[i] = False
        for j, v in enumerate(node.bottoms):
            name = plan.blobs[v] if v >= 0 else ""
            if contributes:
                under_loss.add(name)
            else:
                bottom_needs[i][j] = False
            if not bottom_needs[i][j]:
                skipped.add(name)
    if plan.net.force_backward:
        layer_needs = [True] * len(plan.nodes)
        bottom_needs = [
            [need or j not in label_bottoms[i] for j, need in enumerate(needs)] for i, needs in enumerate(bottom_needs)
        ]
    written = [
        tuple(need or (layer_needs[i] and j in ignoring[i]) for j, need in enumerate(needs))
        for i, needs in enumerate(bottom_needs)
    ]
    maker_needs = {v: needs for node, needs in zip(plan.nodes, layer_needs, strict=True) for v in node.tops}
    computed = [
        tuple(
            need or (writes and maker_needs.get(v, False))
            for need, writes, v in zip(bottom_needs[i], written[i], node.bottoms, strict=True)
        )
        for i, node in enumerate(plan.nodes)
    ]
    return Backward(tuple(layer_needs), tuple(tuple(needs) for needs in bottom_needs), tuple(computed), tuple(written))


def unblocked(plan: Plan, backward: Backward) -> Plan:
    """Return the plan with ``blocked`` set only where the gradient of a bottom is not computed."""
    nodes = [
        replace(node, blocked=tuple(stop and not made for stop, made in zip(node.blocked, computed, strict=True)))
        for node, computed in zip(plan.nodes, backward.computed, strict=True)
    ]
    return replace(plan, nodes=tuple(nodes))


def origins(plan: Plan, passes_on: Sequence[bool]) -> tuple[int, ...]:
    """Return, for each value v, the first value that equals it, which may be v itself.

    ``passes_on[i]``: the tops of layer i equal its bottom, as those of a Split, or of a Dropout in phase TEST.
    """
    found = list(range(len(plan.blobs)))
    for node, passes in zip(plan.nodes, passes_on, strict=True):
        if passes:
            for v in node.tops:
                found[v] = found[node.bottoms[0]]
    return tuple(found)
