"""What the numbers of a training follow from, besides its weights and data: kept in ``X.solverstate.extra``.

A training that is resumed with other settings warns of each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from netspec.net.ignored_fields import HOW_NOT_WHAT
from netspec.net.net import Net
from netspec.net.stamp import shown
from netspec.proto.schema import fields_of

Settings = dict[str, dict[str, Any]]  # of the solver, and of each net: name -> a value of JSON
MOST_TOLD = 6

_SOLVER_ASIDE = frozenset(  # what the log shows, what is written, and what is compared elsewhere
    {
        *("net", "net_param", "train_net", "train_net_param", "test_net", "test_net_param"),
        *("train_state", "test_state", "weights", "random_seed", "solver_mode", "device_id"),
        *("display", "average_loss", "debug_info", "test_initialization", "test_compute_loss", "layer_wise_reduce"),
        *("snapshot", "snapshot_prefix", "snapshot_diff", "snapshot_format", "snapshot_after_train"),
    }
)
_LAYER_ASIDE = HOW_NOT_WHAT | {
    *("name", "bottom", "top", "blobs", "include", "exclude", "phase", "prefetch"),
    *("weight_filler", "bias_filler", "filler"),  # they have done their work
}


def settings_of(param: Any, nets: Mapping[str, Net], manner: Mapping[str, Any]) -> Settings:
    """Return the settings of a solver, of its nets by name, and ``manner``: how they are run."""
    aside = _SOLVER_ASIDE if param.lr_policy == "poly" else _SOLVER_ASIDE | {"max_iter"}
    found: Settings = {"solver": {**manner, **dict(_fields(param, aside))}}
    for name, net in nets.items():
        found[name] = {}
        for layer in net.layers:
            for field, value in _fields(layer.param, _LAYER_ASIDE):
                found[name][f'layer "{layer.param.name}" {field}'] = value
            if records := getattr(layer, "num_records", 0):
                found[name][f'layer "{layer.param.name}" number of records'] = records
    return found


def _fields(message: Any, aside: frozenset[str] | set[str]) -> Iterator[tuple[str, Any]]:
    """Yield the fields that have another value than their default; those of messages inside with a path."""
    for name, field in fields_of(message.DESCRIPTOR).items():
        if name in aside or not field.present(message):
            continue
        value = field.get(message)
        if field.descriptor.message_type is None:
            if field.repeated:
                yield name, list(value)
            elif value != field.descriptor.default_value:
                kinds = field.descriptor.enum_type
                yield name, kinds.values_by_number[value].name if kinds else value
            continue
        for i, part in enumerate(value if field.repeated else [value]):
            here = f"{name}[{i}]" if i else name
            for inner, found in _fields(part, aside):
                yield f"{here}.{inner}", found


def changes(before: Settings, now: Settings) -> str:
    """Return what has changed, in words; "" where nothing is. Nets that only one side has are left out."""
    found = []
    for part in now:
        if part in before:
            was, is_now = dict(before[part]), now[part]
            if was.get("compiled") is False:  # as snapshots said while a training could also be compiled
                del was["compiled"]
            of = "" if part == "solver" else f"{part}, "
            for name in [*is_now, *(name for name in was if name not in is_now)]:
                if was.get(name) != is_now.get(name):
                    found.append(f"{of}{name} is {_told(is_now, name)}, was {_told(was, name)}")
    more = f"; and {len(found) - MOST_TOLD} more" if len(found) > MOST_TOLD else ""
    return "; ".join(found[:MOST_TOLD]) + more


def _told(settings: Mapping[str, Any], name: str) -> str:
    if name not in settings:
        return "the default"
    value = settings[name]
    return f"{value:.7g}" if isinstance(value, float) else shown(value)
