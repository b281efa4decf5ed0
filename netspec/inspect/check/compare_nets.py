"""Compares two nets layer by layer: the blobs that each reads, its settings, and its shared parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from netspec import log
from netspec.graph.filter import filter_net, with_state
from netspec.graph.plan import Node, Plan, make_plan
from netspec.inspect.check.difference import Difference, Differences, child, differences, labeled
from netspec.proto.schema import PHASE_NAMES, TEST, TRAIN, NetParameter, ParamSpec
from netspec.proto.source_map import SourceMap

_WIRING = ("name", "bottom", "top", "param", "blobs", "phase", "include", "exclude", "propagate_down", "loss_weight")
_NOT_THE_NET = ("layer", "layers", "state", "input", "input_shape", "input_dim")
LOSS = "Loss"  # the ending of types with a default loss weight of 1
Key = tuple[str, int]  # the name of a layer, and its index among layers with that name


@dataclass(frozen=True)
class _PlannedNet:
    """A net in one NetState."""

    plan: Plan
    keys: dict[Key, int]  # the number of each layer in the plan
    makers: dict[int, tuple[Key, int]]  # the layer and the top that compute each value


def compare_nets(first: tuple[NetParameter, SourceMap], second: tuple[NetParameter, SourceMap]) -> Differences:
    """Yield the differences in phase TRAIN, in phase TEST, or in both."""
    by_phase = []
    for phase in (TRAIN, TEST):
        one, other = ((with_state(net, phase), source) for net, source in (first, second))
        by_phase.append({str(each): each for each in compare_in_state(one, other)})
    for text, each in {**by_phase[0], **by_phase[1]}.items():
        only = [PHASE_NAMES[k] for k, found in enumerate(by_phase) if text in found]
        yield each if len(only) == 2 else replace(each, message=f"in phase {only[0]} {each.message}")
    yield from _rules(first, second)


def compare_in_state(first: tuple[NetParameter, SourceMap], second: tuple[NetParameter, SourceMap]) -> Differences:
    """Yield the differences between two nets, each filtered by its ``state``."""
    (net, source), (other_net, other_source) = second, first
    yield from differences(other_net, net, source.net, other_source.net, _NOT_THE_NET)
    old, new = (_planned(*each) for each in (first, second))
    names = _matched(old, new)
    for key, i in old.keys.items():
        if key not in names:
            where = old.plan.source.at(i, layer=key[0], type=old.plan.nodes[i].type)
            yield Difference(where, "is only here, not in the second net")
    back = {to: key for key, to in names.items()}
    for key, i in new.keys.items():
        if key in back:
            yield from _layers(old, new, old.keys[back[key]], i, names)
        else:
            where = new.plan.source.at(i, layer=key[0], type=new.plan.nodes[i].type)
            yield Difference(where, "is only here, not in the first net")


def _planned(net: NetParameter, source: SourceMap) -> _PlannedNet:
    with log.silent():
        filtered, placed = filter_net(net, source)
    plan = make_plan(filtered, placed.reporting_to(lambda fault: None))
    keys = _keys(node.name for node in plan.nodes)
    makers = {v: (key, j) for key, node in zip(keys, plan.nodes, strict=True) for j, v in enumerate(node.tops)}
    return _PlannedNet(plan, {key: i for i, key in enumerate(keys)}, makers)


def _keys(names: Iterable[str]) -> list[Key]:
    counts: Counter[str] = Counter()
    keys = []
    for name in names:
        keys.append((name, counts[name]))
        counts[name] += 1
    return keys


def _matched(old: _PlannedNet, new: _PlannedNet) -> dict[Key, Key]:
    """Match the layers of the second net to those of the first, by name, or by equal settings, in order."""
    names = {key: key for key in old.keys if key in new.keys}
    left = [key for key in new.keys if key not in names]
    for key in old.keys:
        if key in names:
            continue
        for candidate in left:
            if _alike(old, old.keys[key], new, new.keys[candidate]):
                names[key] = candidate
                left.remove(candidate)
                break
    return names


def _alike(old: _PlannedNet, i: int, new: _PlannedNet, j: int) -> bool:
    one, other = old.plan.net.layer[i], new.plan.net.layer[j]
    position = old.plan.source.layers[i]
    return one.type == other.type and not any(differences(one, other, position, position, _WIRING))


def _layers(old: _PlannedNet, new: _PlannedNet, i: int, j: int, names: Mapping[Key, Key]) -> Differences:
    """Yield the differences between two matched layers."""
    one, other = old.plan.net.layer[i], new.plan.net.layer[j]
    there, here = old.plan.source.layers[i], new.plan.source.layers[j]
    found = [
        *_own(old.plan.nodes[i], new.plan.nodes[j], one, other, here, there),
        *differences(one, other, here, there, _WIRING),
        *_reads(old, new, i, j, names),
        *_params(old, new, i, j, names),
    ]
    for each in found:
        yield labeled(each, other)


def _own(old: Node, new: Node, one: Any, other: Any, here: Any, there: Any) -> Differences:
    if one.name != other.name:
        yield Difference(here.find("name"), f'was called "{one.name}"', there.find("name"))
    for k, (a, b) in enumerate(zip(one.top, other.top, strict=False)):
        if a != b and not (k < len(old.in_place) and old.in_place[k]) and not new.in_place[k]:
            yield Difference(here.find("top", k), f'top {k} is "{b}", was "{a}"', there.find("top", k))
    if len(one.top) != len(other.top):
        yield Difference(here.find("top"), f"{len(other.top)} tops, were {len(one.top)}", there.find("top"))
    weights = [list(layer.loss_weight) or [1.0] * layer.type.endswith(LOSS) for layer in (one, other)]
    if weights[0] != weights[1]:
        was, now = (" ".join(f"{w:g}" for w in each) or "absent" for each in weights)
        yield Difference(here.find("loss_weight"), f"loss_weight is {now}, was {was}", there.find("loss_weight"))
    if old.blocked != new.blocked and len(old.blocked) == len(new.blocked):
        was, now = (" ".join("false" if each else "true" for each in node.blocked) for node in (old, new))
        yield Difference(
            here.find("propagate_down"), f"propagate_down is {now}, was {was}", there.find("propagate_down")
        )


def _reads(old: _PlannedNet, new: _PlannedNet, i: int, j: int, names: Mapping[Key, Key]) -> Differences:
    """Yield the bottoms that now come from a different layer or top."""
    before, after = old.plan.nodes[i], new.plan.nodes[j]
    there, here = old.plan.source.layers[i], new.plan.source.layers[j]
    if len(before.bottoms) != len(after.bottoms):
        message = f"{len(after.bottoms)} bottoms, were {len(before.bottoms)}"
        yield Difference(here.find("bottom"), message, there.find("bottom"))
    for k, (a, b) in enumerate(zip(before.bottoms, after.bottoms, strict=False)):
        maker, top = old.makers.get(a, (("", 0), 0))
        was = (names.get(maker, maker), top) if a >= 0 else None
        now = new.makers.get(b)
        if was != now:
            message = f"bottom {k} is {_maker_text(new, now)}, was {_maker_text(old, old.makers.get(a))}"
            yield Difference(here.find("bottom", k), message, there.find("bottom", k))


def _maker_text(seen: _PlannedNet, maker: tuple[Key, int] | None) -> str:
    if maker is None:
        return "a blob that no layer makes"
    (name, _), top = maker
    blob = seen.plan.net.layer[seen.keys[maker[0]]].top[top]
    return f'"{blob}" of layer "{name}"'


def _params(old: _PlannedNet, new: _PlannedNet, i: int, j: int, names: Mapping[Key, Key]) -> Differences:
    """Yield changed multipliers, and parameters that are shared with different layers."""
    one, other = old.plan.net.layer[i], new.plan.net.layer[j]
    there, here = old.plan.source.layers[i], new.plan.source.layers[j]
    for k in range(max(len(one.param), len(other.param))):
        specs = [layer.param[k] if k < len(layer.param) else ParamSpec() for layer in (one, other)]
        positions = child(here, "param", k), child(there, "param", k)
        for each in differences(specs[0], specs[1], *positions, ignored=("name",)):
            yield replace(each, message=f"param {k}: {each.message}")
        was, now = _owner(old, i, k), _owner(new, j, k)
        if (was and (names.get(was[0], was[0]), was[1])) != now:
            message = f"param {k} is {_shared(now)}, was {_shared(was)}"
            yield Difference(positions[0].where, message, positions[1].where)


def _owner(seen: _PlannedNet, i: int, k: int) -> tuple[Key, int] | None:
    params = seen.plan.nodes[i].params
    owner = params[k].owner if k < len(params) else None
    if owner is None:
        return None
    return next(key for key, number in seen.keys.items() if number == owner[0]), owner[1]


def _shared(owner: tuple[Key, int] | None) -> str:
    return f'that of layer "{owner[0][0]}"' if owner else "the layer's own"


def _rules(first: tuple[NetParameter, SourceMap], second: tuple[NetParameter, SourceMap]) -> Differences:
    """Yield changed rules about levels and stages. Rules about phases show in the layers of each phase."""
    old = {key: i for i, key in enumerate(_keys(layer.name for layer in first[0].layer))}
    for j, key in enumerate(_keys(layer.name for layer in second[0].layer)):
        i, layer = old.get(key), second[0].layer[j]
        if i is None:
            continue
        for name in ("include", "exclude"):
            was, now = (sorted(_levels(getattr(each, name))) for each in (first[0].layer[i], layer))
            if was != now:
                where = second[1].at(j, name, layer=layer.name, type=layer.type)
                yield Difference(where, f"{name} has other levels or stages", first[1].at(i, name))


def _levels(rules: Any) -> Iterator[bytes]:
    for rule in rules:
        if rule.stage or rule.not_stage or rule.HasField("min_level") or rule.HasField("max_level"):
            yield rule.SerializeToString(deterministic=True)
