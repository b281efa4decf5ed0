"""``X.solverstate.extra``: what Caffe's ``X.solverstate`` lacks to go on as if a training had never stopped.

Caffe keeps neither its place in the data nor its random numbers. Here all draws of an iteration follow from the seed
and the iteration alone, so the file has the seeds, the places in the data, what layers remember from pass to pass, and
the losses that ``average_loss`` still needs. It also has the sizes and hashes of the weights and of the state that
belong together. It is JSON; Caffe never reads it.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from netspec import log
from netspec.errors import SpecError, Where
from netspec.net.net import Net
from netspec.solver.snapshot import find_learned_net, read_state
from netspec.whole_file import whole_file

FORMAT = 1
_BLOCK = 1 << 20  # bytes


@dataclass(frozen=True)
class Stamp:
    """The size and the hash of a file."""

    size: int
    hash: str


@dataclass(frozen=True)
class Extra:
    """What the file has.

    ``seed`` is the solver's; ``losses`` are the last ``average_loss`` ones; ``nets`` has, for the training nets of all
    ranks and the test nets, in this order, what each of their layers remembers (``Layer.running_state``), by the
    layer's number.
    """

    seed: int
    losses: list[float]
    nets: list[dict[str, dict[str, Any]]]
    weights: Stamp
    state: Stamp


def path_beside(state: str | Path) -> Path:
    """Return the path of the file that belongs to a .solverstate or .solverstate.h5."""
    return Path(f"{state}.extra")


def stamp_of(path: str | Path) -> Stamp:
    """Return the stamp of a file. Raises OSError if it cannot be read."""
    size, hashed = 0, hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        while block := file.read(_BLOCK):
            size += len(block)
            hashed.update(block)
    return Stamp(size, hashed.hexdigest())


def running_state(net: Net) -> dict[str, dict[str, Any]]:
    """Return what the layers of a net remember, as JSON has it."""
    states = {str(i): layer.running_state() for i, layer in enumerate(net.layers)}
    return {i: {name: _packed(value) for name, value in state.items()} for i, state in states.items() if state}


def resume(net: Net, states: dict[str, dict[str, Any]]) -> None:
    """Make the layers of a net remember what :func:`running_state` returned. Raises SpecError if it does not fit."""
    for i, state in states.items():
        if not 0 <= int(i) < len(net.layers):
            raise SpecError(f"remembers layer {i} of a net of {len(net.layers)} layers")
        net.layers[int(i)].resume({name: _unpacked(value) for name, value in state.items()})


def write_extra(path: str | Path, extra: Extra) -> None:
    """Write the file. Raises SpecError if it cannot be written."""
    with whole_file(path) as unfinished:
        unfinished.write_text(json.dumps({"format": FORMAT, **asdict(extra)}, indent=1) + "\n")


def read_extra(state: str | Path) -> Extra | None:
    """Return what lies beside a state; None if nothing does: it is Caffe's. Raises SpecError for any other file."""
    path = path_beside(state)
    try:
        found = json.loads(path.read_text())
        if found.pop("format") != FORMAT:
            raise ValueError(f"format {FORMAT} is known")
        stamps = {name: Stamp(int(found[name]["size"]), str(found[name]["hash"])) for name in ("weights", "state")}
        losses = [float(loss) for loss in found["losses"]]
        nets = [{str(int(i)): dict(state) for i, state in net.items()} for net in found["nets"]]
        return Extra(int(found["seed"]), losses, nets, **stamps)
    except FileNotFoundError:
        return None
    except OSError as fault:
        raise SpecError(f"cannot be read: {fault.strerror}", Where(str(path))) from None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as fault:
        reason = " ".join(str(fault).split())
        raise SpecError(
            f"is damaged ({reason}); without it the training resumes as Caffe's", Where(str(path))
        ) from None


def check_pair(state: str | Path, weights: Path | None, extra: Extra) -> None:
    """Raise SpecError where the weights or the state are not those that were written together."""
    for path, stamp in ((weights, extra.weights), (Path(state), extra.state)):
        if path is not None and stamp_of(path) != stamp:
            message = f"is not the file that was written with {path_beside(state).name}: it was cut or replaced"
            raise SpecError(message, Where(str(path)))


def newest_pair(prefix: str) -> Path | None:
    """Return the state, of the snapshots with a prefix, of the latest iteration that is whole with its weights.

    Those that are not whole are named in the log.
    """
    for state in _states(prefix):
        try:
            found = find_learned_net(read_state(state), state)
            extra = read_extra(state)
            if extra is not None:
                check_pair(state, found, extra)
            return state
        except (SpecError, OSError) as fault:
            log.logger.warning(f"passed over: {fault}")
    return None


def _states(prefix: str) -> Iterator[Path]:
    start = Path(f"{prefix}_iter_")
    pattern = re.compile(re.escape(start.name) + r"(\d+)\.solverstate(\.h5)?")
    found = [(match, path) for path in start.parent.glob("*") if (match := pattern.fullmatch(path.name))]
    for _, path in sorted(found, key=lambda pair: (int(pair[0][1]), pair[1].name), reverse=True):
        yield path


def _packed(value: int | Sequence[torch.Tensor]) -> Any:
    if isinstance(value, int):
        return value
    arrays = [tensor.detach().cpu().numpy().astype("<f4") for tensor in value]
    return [{"shape": array.shape, "float32": base64.b64encode(array.tobytes()).decode()} for array in arrays]


def _unpacked(value: Any) -> int | tuple[torch.Tensor, ...]:
    if isinstance(value, int):
        return value
    try:
        data = [np.frombuffer(base64.b64decode(array["float32"]), "<f4").reshape(array["shape"]) for array in value]
    except (ValueError, TypeError, LookupError) as fault:
        raise SpecError(f"has an array that cannot be read ({fault})") from None
    return tuple(torch.tensor(array) for array in data)
