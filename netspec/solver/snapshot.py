"""The state to resume a training from: .solverstate in Caffe's binary format, or in HDF5 (files that end in ``.h5``).

Caffe: SGDSolver::SnapshotSolverState, RestoreSolverState (src/caffe/solvers/sgd_solver.cpp)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from netspec.data import blobs
from netspec.errors import SpecError, Where
from netspec.files.hdf5 import Hdf5Group, hdf5_in, open_hdf5
from netspec.files.whole_file import whole_file
from netspec.proto.binary import read_binary
from netspec.proto.schema import SolverState


@dataclass(frozen=True)
class State:
    """The state of a training.

    ``history`` has one float32 array per learnable parameter, in the net's order. The second set of Adam and AdaDelta
    follows the first. ``iteration`` is the number of updates done. ``learned_net`` is the path of the weights as in
    the file, relative to the working directory of that run.
    """

    iteration: int
    learned_net: str
    current_step: int
    history: list[np.ndarray]


def read_state(path: str | Path) -> State:
    """Read a .solverstate or .solverstate.h5 of Caffe or netspec.

    Raises SpecError for any other file, and for an impossible state.
    """
    state = _read_hdf5(path) if h5py.is_hdf5(path) else _read_binary(path)
    for name, value in (("iter", state.iteration), ("current_step", state.current_step)):
        if value < 0:
            raise SpecError(f"found {name} {value}, expected at least 0", Where(str(path)))
    for i, array in enumerate(state.history):
        if not np.all(np.isfinite(array)):
            raise SpecError(f"history blob {i} has a NaN or an infinity; the training had diverged", Where(str(path)))
    return state


def _read_binary(path: str | Path) -> State:
    proto = read_binary(path, SolverState)
    history = []
    for i, blob in enumerate(proto.history):
        try:
            history.append(blobs.to_array(blob))
        except ValueError as fault:
            raise SpecError(f"history blob {i}: {fault}", Where(str(path))) from None
    return State(proto.iter, proto.learned_net, proto.current_step, history)


def has_squares(history: Sequence[np.ndarray], solver_type: str) -> bool:
    """Return whether the second half of a history is a second set, such as Adam's squares, that the type lacks."""
    half = len(history) // 2
    first, second = (any((array < 0).any() for array in part) for part in (history[:half], history[half:]))
    return not second and (first or solver_type in ("SGD", "Nesterov"))


def merge_shared(history: list[np.ndarray], owners: Sequence[int]) -> list[np.ndarray]:
    """Return one array for each learnable parameter, from a history with one for each layer that shares it.

    Caffe wrote such a history before August 2015, when shared parameters got a single gradient. ``owners`` has, for
    each blob of each layer, the index of its parameter. Before, each layer's gradient had its own history, and the sum
    of their updates changed the parameter, so the histories are added. Equal ones are copies, and are counted once.
    """
    sets = len(history) // len(owners)
    parts: dict[tuple[int, int], list[np.ndarray]] = {}
    for i, array in enumerate(history):
        parts.setdefault((i // len(owners), owners[i % len(owners)]), []).append(array)
    assert len(parts) == sets * (max(owners) + 1), "every parameter belongs to a layer"
    merged = []
    for _, arrays in sorted(parts.items(), key=lambda item: item[0]):
        first = arrays[0]
        others = [array.reshape(first.shape) for array in arrays[1:]]
        copies = all(np.array_equal(first, other) for other in others)
        merged.append(first if copies else np.sum([first, *others], axis=0, dtype=first.dtype))
    return merged


def write_state(path: str | Path, state: State, before: Callable[[Path], object] = lambda unfinished: None) -> None:
    """Write the state atomically; ``before`` is called with the complete file before it is renamed to its path.

    Raises SpecError if it cannot be written.
    """
    with whole_file(path) as unfinished:
        if str(path).endswith(".h5"):
            _write_hdf5(unfinished, state)
        else:
            proto = SolverState(iter=state.iteration, learned_net=state.learned_net, current_step=state.current_step)
            proto.history.extend(blobs.from_array(array) for array in state.history)
            unfinished.write_bytes(proto.SerializeToString(deterministic=True))
        before(unfinished)


def find_learned_net(state: State, path: str | Path) -> Path:
    """Return the file of the state's weights, in the state's folder or at the path that it names.

    Raises SpecError if there is none.
    """
    if not state.learned_net:
        raise SpecError("names no weights to resume with", Where(str(path)))
    written = Path(state.learned_net)
    near = Path(path).parent / written.name
    for candidate in (near, written):
        if os.path.isfile(candidate):
            return candidate
    raise SpecError(f"its weights are neither {near} nor {written}", Where(str(path)))


def _read_hdf5(path: str | Path) -> State:
    with open_hdf5(path) as file:
        for name in ("iter", "current_step", "history"):
            if name not in file.names():
                raise SpecError(f"this is not a solver state: the HDF5 file has no /{name}")
        history = file.group("history")
        if history is None:
            raise SpecError("this is not a solver state: /history is not a group")
        learned_net = bytes(file.values("learned_net").item()).decode() if "learned_net" in file.names() else ""
        arrays = [history.values(str(i)).astype(np.float32) for i in range(len(history.names()))]
        iteration, step = (_whole_number(file, name) for name in ("iter", "current_step"))
        return State(iteration, learned_net, step, arrays)


def _whole_number(group: Hdf5Group, name: str) -> int:
    values = group.values(name)
    if values.size != 1 or values.dtype.kind not in "iu":
        raise SpecError(f"/{name} is not a single integer")
    return int(values.item())


def _write_hdf5(path: Path, state: State) -> None:
    learned_net = state.learned_net.encode()
    with hdf5_in(path) as file:
        file.create_dataset("iter", data=np.array([state.iteration], np.int32))
        file.create_dataset("learned_net", data=np.array(learned_net, f"S{len(learned_net) + 1}"))
        file.create_dataset("current_step", data=np.array([state.current_step], np.int32))
        history = file.create_group("history")
        for i, array in enumerate(state.history):
            history.create_dataset(str(i), data=array)
