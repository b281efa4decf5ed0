"""``X.solverstate.extra``: what Caffe's ``X.solverstate`` lacks to go on as if a training had never stopped.

Caffe keeps neither its place in the data nor its random numbers. Here all draws of an iteration follow from the seed
and the iteration alone, so the file has the seeds, the places in the data, what layers remember from pass to pass, and
the losses that ``average_loss`` still needs. It also has the settings that the numbers follow from, and the sizes and
hashes of the weights and of the state that belong together (netspec/net/sealed.py). Caffe never reads it.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from netspec import log
from netspec.errors import SpecError, Where
from netspec.files.whole_file import write_whole
from netspec.layers.contract import reading
from netspec.net.assembly import WITHOUT_EFFECT
from netspec.net.net import Net
from netspec.net.sealed import FAULTS, Digest, damaged, sealed, shown, unsealed, whole_number
from netspec.proto.schema import fields_of
from netspec.solver.snapshot import find_learned_net, read_state

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
_LAYER_ASIDE = WITHOUT_EFFECT | {
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


_MOST_LAYERS = 1 << 24
Remembered = dict[str, dict[str, Any]]  # by the layer's number, then by name: what JSON has of it


@dataclass(frozen=True)
class Extra:
    """What the file has.

    ``seed`` is the solver's; ``losses`` are the last ``average_loss`` ones; ``nets`` has, for the training nets of all
    ranks and the test nets, in this order, what each of their layers remembers (netspec/layers/contract/reading.py).
    """

    seed: int
    losses: list[float]
    nets: list[Remembered]
    settings: Settings
    weights: Digest
    state: Digest


def path_beside(state: str | Path) -> Path:
    """Return the path of the file that belongs to a .solverstate or .solverstate.h5."""
    return Path(f"{state}.extra")


def running_state(net: Net) -> Remembered:
    """Return what the layers of a net remember, as JSON has it."""
    states = {str(i): reading.running_state(layer) for i, layer in enumerate(net.layers)}
    return {i: {name: _packed(value) for name, value in state.items()} for i, state in states.items() if state}


def resume(net: Net, states: Remembered) -> None:
    """Make the layers of a net remember what :func:`running_state` returned. Raises SpecError if it does not fit."""
    for i, state in states.items():
        if int(i) >= len(net.layers):
            raise SpecError(f"remembers layer {i} of a net of {len(net.layers)} layers")
        reading.resume(net.layers[int(i)], {name: _unpacked(value) for name, value in state.items()})


def write_extra(path: str | Path, extra: Extra) -> None:
    """Write the file. Raises SpecError if it cannot be written."""
    write_whole(path, sealed(asdict(extra)))


def read_extra(state: str | Path) -> Extra | None:
    """Return the Extra of a state; None if there is no such file, as with Caffe's. Raises SpecError if it is bad."""
    path = path_beside(state)
    try:
        found = unsealed(path)
        return Extra(
            whole_number(found["seed"], "seed"),
            [_loss(loss) for loss in _list(found["losses"])],
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
    """Raise SpecError where the weights or the state are not those that were written together."""
    for path, stamp in ((weights, extra.weights), (Path(state), extra.state)):
        if path is not None:
            stamp.check(path, path_beside(state))


def newest_pair(prefix: str) -> Path | None:
    """Return the state, of the snapshots with a prefix, of the latest iteration that is whole with its weights.

    Those that are not whole are named in the log. None if there is no snapshot at all; raises SpecError if there are
    some, and none is whole: a training must not begin anew, and write over them, without a word.
    """
    passed = 0
    for state in _newest_first(prefix):
        try:
            found = find_learned_net(read_state(state), state)
            extra = read_extra(state)
            if extra is not None:
                check_pair(state, found, extra)
            return state
        except (SpecError, OSError) as fault:
            log.logger.warning(f"passed over: {fault}")
            passed += 1
    if passed:
        message = f'none of the {passed} snapshots with the prefix "{prefix}" is whole; move them away to start anew'
        raise SpecError(f"{message}, or give one with --snapshot", Where(prefix))
    return None


def _newest_first(prefix: str) -> Iterator[Path]:
    start = Path(f"{prefix}_iter_")
    pattern = re.compile(re.escape(start.name) + r"(\d+)\.solverstate(\.h5)?")
    found = [(match, path) for path in start.parent.glob("*") if (match := pattern.fullmatch(path.name))]
    for _, path in sorted(found, key=lambda pair: (int(pair[0][1]), pair[1].name), reverse=True):
        yield path


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"found {shown(value)}, expected a list")
    return value


def _loss(value: Any) -> float:
    if type(value) not in (int, float):  # NaN is possible: ``--nan warn``
        raise ValueError(f"found loss {shown(value)}, expected a number")
    return float(value)


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
