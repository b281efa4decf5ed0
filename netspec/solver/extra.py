"""``X.solverstate.extra``: the state that Caffe's ``X.solverstate`` lacks for resuming with bit-identical results.

Caffe saves neither its position in the data nor its random numbers. In netspec, all random numbers depend only on the
seed and the iteration. The file has the seeds, the positions in the data, the state that layers keep between passes,
the losses that ``average_loss`` still needs, and the loss scale of fp16. It also has the settings that affect the
results, and the sizes and hashes of the weights and the state that belong to it (netspec/net/extra_file.py). Caffe does
not read it.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from netspec.errors import SpecError
from netspec.files.whole_file import write_whole
from netspec.net.assembly import WITHOUT_EFFECT
from netspec.net.extra_file import FAULTS, Digest, damaged, extra_text, read_content, shown, whole_number
from netspec.net.net import Net
from netspec.proto.schema import given

Settings = dict[str, dict[str, Any]]  # for the solver and for each net: name -> JSON value
MOST_LISTED = 6

# Settings of the log and of output files, and settings that are compared elsewhere.
_IGNORED_IN_SOLVERS = frozenset(
    {
        "net",
        "net_param",
        "train_net",
        "train_net_param",
        "test_net",
        "test_net_param",
        "train_state",
        "test_state",
        "weights",
        "random_seed",
        "solver_mode",
        "device_id",
        "display",
        "average_loss",
        "debug_info",
        "test_initialization",
        "test_compute_loss",
        "layer_wise_reduce",
        "snapshot",
        "snapshot_prefix",
        "snapshot_diff",
        "snapshot_format",
        "snapshot_after_train",
    }
)
_IGNORED_IN_LAYERS = WITHOUT_EFFECT | {
    "name",
    "bottom",
    "top",
    "blobs",
    "include",
    "exclude",
    "phase",
    "prefetch",
    # Fillers no longer have an effect.
    "weight_filler",
    "bias_filler",
    "filler",
}


def settings_of(param: Any, nets: Mapping[str, Net], run_settings: Mapping[str, Any]) -> Settings:
    """Return the settings of a solver, of its nets by name, and ``run_settings``, which say how they are run."""
    ignored = _IGNORED_IN_SOLVERS if param.lr_policy == "poly" else _IGNORED_IN_SOLVERS | {"max_iter"}
    found: Settings = {"solver": {**run_settings, **dict(_fields(param, ignored))}}
    for name, net in nets.items():
        found[name] = {}
        for layer in net.layers:
            for field, value in _fields(layer.param, _IGNORED_IN_LAYERS):
                found[name][f'layer "{layer.param.name}" {field}'] = value
        for layer in net.data_layers:
            if records := layer.num_records:
                found[name][f'layer "{layer.param.name}" number of records'] = records
    return found


def _fields(message: Any, ignored: frozenset[str] | set[str]) -> Iterator[tuple[str, Any]]:
    """Yield the fields whose value is not the default; fields of inner messages have a path."""
    for field in given(message):
        name = field.name
        if name in ignored:
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
            for inner, found in _fields(part, ignored):
                yield f"{here}.{inner}", found


def changes(before: Settings, now: Settings) -> str:
    """Return a description of the changed settings; "" if there are none. Nets that only one side has are ignored."""
    found = []
    for part in now:
        if part in before:
            was, is_now = before[part], now[part]
            of = "" if part == "solver" else f"{part}, "
            for name in [*is_now, *(name for name in was if name not in is_now)]:
                if was.get(name) != is_now.get(name):
                    found.append(f"{of}{name} is {_value_text(is_now, name)}, was {_value_text(was, name)}")
    more = f"; and {len(found) - MOST_LISTED} more" if len(found) > MOST_LISTED else ""
    return "; ".join(found[:MOST_LISTED]) + more


def _value_text(settings: Mapping[str, Any], name: str) -> str:
    if name not in settings:
        return "the default"
    value = settings[name]
    return f"{value:.7g}" if isinstance(value, float) else shown(value)


_MOST_LAYERS = 1 << 24
Remembered = dict[str, dict[str, Any]]  # index of the layer -> name -> JSON value


@dataclass(frozen=True)
class Extra:
    """The contents of the file.

    ``seed`` is the solver's. ``losses`` are the last ``average_loss`` losses. ``loss_scale`` is ``LossScale.state``
    (netspec/solver/precision.py). ``nets`` has the state of the layers of the training nets of all ranks, then of the
    test nets (netspec/layers/contract/base.py).
    """

    seed: int
    losses: list[float]
    loss_scale: list[float]
    nets: list[Remembered]
    settings: Settings
    weights: Digest
    state: Digest


def extra_path(state: str | Path) -> Path:
    """Return the path of the file that belongs to a .solverstate or .solverstate.h5."""
    return Path(f"{state}.extra")


def running_state(net: Net) -> Remembered:
    """Return the state of a net's layers as JSON values."""
    states = {str(i): layer.running_state() for i, layer in enumerate(net.layers)}
    return {i: {name: _packed(value) for name, value in state.items()} for i, state in states.items() if state}


def resume(net: Net, states: Remembered) -> None:
    """Restore the state that :func:`running_state` returned. Raises SpecError if it does not fit the net."""
    for i, state in states.items():
        if int(i) >= len(net.layers):
            raise SpecError(f"has the state of layer {i}, but the net has {len(net.layers)} layers")
        net.layers[int(i)].restore({name: _unpacked(value) for name, value in state.items()})


def write_extra(path: str | Path, extra: Extra) -> None:
    """Write the file. Raises SpecError if it cannot be written."""
    write_whole(path, extra_text(asdict(extra)))


def read_extra(state: str | Path) -> Extra | None:
    """Return the Extra of a state; None if there is no such file, as for Caffe's states. Raises SpecError."""
    path = extra_path(state)
    try:
        found = read_content(path)
        return Extra(
            whole_number(found["seed"], "seed"),
            [_loss(loss) for loss in _list(found["losses"])],
            _loss_scale(_list(found.get("loss_scale", []))),  # older files lack it
            [_checked_states(net) for net in _list(found["nets"])],
            {str(name): dict(settings) for name, settings in found["settings"].items()},
            Digest.read(found["weights"]),
            Digest.read(found["state"]),
        )
    except FileNotFoundError:
        return None
    except SpecError:
        raise
    except FAULTS as fault:
        raise damaged(path, fault) from None


def check_pair(state: str | Path, weights: Path | None, extra: Extra) -> None:
    """Raise SpecError if the weights or the state were not written together with the file."""
    for path, stamp in ((weights, extra.weights), (Path(state), extra.state)):
        if path is not None:
            stamp.check(path, extra_path(state))


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"found {shown(value)}, expected a list")
    return value


def _loss(value: Any) -> float:
    if type(value) not in (int, float):  # may be NaN with ``--nan warn``
        raise ValueError(f"found loss {shown(value)}, expected a number")
    return float(value)


def _loss_scale(value: list[Any]) -> list[float]:
    if value and not (len(value) == 2 and all(type(each) in (int, float) and 0 <= each < math.inf for each in value)):
        raise ValueError(f"found loss_scale {shown(value)}, expected two numbers")
    return value


def _checked_states(value: Any) -> Remembered:
    for i, state in value.items():
        whole_number(int(i), "layer", _MOST_LAYERS)
        for name, each in state.items():
            if not isinstance(each, (str, list)):
                whole_number(each, name)
            _unpacked(each)
    return value


def _packed(value: int | str | Sequence[torch.Tensor]) -> Any:
    if isinstance(value, (int, str)):
        return value
    arrays = [tensor.detach().cpu().numpy().astype("<f4") for tensor in value]
    return [{"shape": array.shape, "float32": base64.b64encode(array.tobytes()).decode()} for array in arrays]


def _unpacked(value: Any) -> int | str | tuple[torch.Tensor, ...]:
    if isinstance(value, (int, str)):
        return value
    return tuple(torch.tensor(_unpacked_array(each)) for each in value)


def _unpacked_array(value: Any) -> np.ndarray:
    shape = [whole_number(size, "size") for size in _list(value["shape"])]
    return np.frombuffer(base64.b64decode(value["float32"], validate=True), "<f4").reshape(shape)
