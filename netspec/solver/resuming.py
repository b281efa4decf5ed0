"""Taking snapshots of a training, and resuming from them.

Caffe: Solver::Snapshot, Solver::Restore (src/caffe/solver.cpp), SGDSolver::RestoreSolverState (sgd_solver.cpp)
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from netspec import log
from netspec.errors import SpecError, Where
from netspec.files.whole_file import only_one
from netspec.net.extra_file import Digest
from netspec.net.weights import load_weights, save_weights
from netspec.proto.schema import SolverParameter
from netspec.solver import nets
from netspec.solver.checks import check_prefix, divided_sums
from netspec.solver.extra import (
    Extra,
    Remembered,
    Settings,
    changes,
    check_pair,
    extra_path,
    read_extra,
    resume,
    running_state,
    settings_of,
    write_extra,
)
from netspec.solver.snapshot import State, find_learned_net, has_squares, merge_shared, read_state, write_state
from netspec.solver.training import Training


@dataclass(frozen=True)
class Progress:
    """How far a training was: its iteration, the step of its rate, and the losses that it averaged."""

    iteration: int
    current_step: int
    losses: tuple[float, ...] = ()


@contextmanager
def sole_writer(training: Training) -> Iterator[None]:
    """Within the block, refuse another process that would write snapshots of the same names, if this one will.

    Raises SpecError if there is one already, or if the snapshot_prefix is not writable.
    """
    param = training.param
    if not training.is_root or not (param.snapshot or param.snapshot_after_train):
        yield
        return
    check_prefix(param, training.node)
    folder, name = os.path.split(param.snapshot_prefix)
    lock = os.path.join(folder, f".{name}.lock")
    with only_one(lock, f'give each training a snapshot_prefix of its own, not "{param.snapshot_prefix}" to both'):
        yield


def write_snapshot(training: Training, tested: Sequence[Remembered]) -> tuple[str, str]:
    """Write the weights and the state; return their paths, ``PREFIX_iter_N.caffemodel`` and ``.solverstate``.

    ``tested`` are the running states of the test nets. With ``snapshot_format: HDF5`` both paths end in ``.h5``. If
    there are several processes, the root writes them. Raises SpecError if they cannot be written.
    """
    hdf5 = training.param.snapshot_format == SolverParameter.SnapshotFormat.Value("HDF5")
    form, ending = ("HDF5", ".h5") if hdf5 else ("binary proto", "")
    stem = f"{training.param.snapshot_prefix}_iter_{training.iteration}"
    model, state = f"{stem}.caffemodel{ending}", f"{stem}.solverstate{ending}"
    trained = [running_state(net) for net in (training.net, *training.replicas.nets)]
    of_all_ranks = [states for gathered in training.options.processes.gather(trained) for states in gathered]
    if not training.is_root:
        return model, state
    log.info("solver.cpp:474" if hdf5 else "solver.cpp:464", f"Snapshotting to {form} file {model}")
    save_weights(training.net, model, training.param.snapshot_diff)
    site = "sgd_solver.cpp:296" if hdf5 else "sgd_solver.cpp:284"
    log.info(site, f"Snapshotting solver state to {form} file {state}")
    history = [values.cpu().numpy() for values in training.history]
    weights, settings = Digest.of(model), _settings(training)
    write_state(
        state,
        State(training.iteration, model, training.current_step, history),
        before=lambda unfinished: write_extra(
            extra_path(state),
            Extra(
                training.seed,
                list(training.losses),
                training.scale.state,
                [*of_all_ranks, *tested],
                settings,
                weights,
                Digest.of(unfinished),
            ),
        ),
    )
    return model, state


def restore(training: Training, path: str | Path) -> Progress:
    """Resume from a .solverstate or .solverstate.h5, of Caffe or of netspec, and from its weights.

    With the file ``X.solverstate.extra`` next to it, the results are as if the training had never stopped. Without
    it, the data layers start again at their first record, as in Caffe. Raises SpecError, and changes nothing, if
    the state does not fit this solver's type and net.
    """
    where = Where(str(path))
    extra = read_extra(path)
    state = _in_current_form(training, read_state(path), where)
    if len(state.history) != len(training.history):
        found, expected = len(state.history), len(training.history)
        message = f"incorrect length of history blobs: found {found}, expected {expected} for this net and solver type"
        raise SpecError(f"{message} {training.param.type}", where)
    for i, (mine, theirs) in enumerate(zip(training.history, state.history, strict=True)):
        if not _same_shape(tuple(mine.shape), theirs.shape):
            raise SpecError(f"history blob {i} has shape {theirs.shape}, expected {tuple(mine.shape)}", where)
    learned_net = find_learned_net(state, path)
    if extra is not None:
        check_pair(path, learned_net, extra)
    load_weights(training.net, learned_net, strict=True)
    log.info("sgd_solver.cpp:336", "SGDSolver: restoring history")
    for mine, theirs in zip(training.history, state.history, strict=True):
        mine.copy_(torch.tensor(theirs).view(mine.shape))
    for net in (training.net, *training.test_nets):
        net.restart_data()
    training.replicas.restart_data()
    training.scale.resume([] if extra is None else extra.loss_scale)
    if extra is not None:
        losses = _resume_data(training, extra, Where(str(extra_path(path))))
        return Progress(state.iteration, state.current_step, losses)
    log.logger.info(f"{path} is from Caffe: the data starts at its first record, with different random numbers")
    return Progress(state.iteration, state.current_step)


def _resume_data(training: Training, extra: Extra, where: Where) -> tuple[float, ...]:
    """Restore the position in the data. Return the losses of the average."""
    trained, rank = (training.net, *training.replicas.nets), training.options.processes.rank
    ranks = len(trained) * training.options.processes.count
    if len(extra.nets) != ranks + training.count_of_tests:
        expected = f"{ranks} of training and {training.count_of_tests} of testing"
        log.logger.warning(f"{where}: found {len(extra.nets)} nets, expected {expected}; the data starts again")
        return ()
    all_nets = (*trained, *training.test_nets)
    remembered = extra.nets[rank : rank + len(trained)] + extra.nets[ranks:][: len(training.test_nets)]
    try:
        for net, states in zip(all_nets, remembered, strict=True):
            resume(net, states)
    except SpecError as fault:
        raise SpecError(fault.message, where) from None
    if extra.seed != training.seed:
        log.logger.warning(f"{where}: random_seed was {extra.seed}; the random numbers differ from here on")
    elif changed := changes(extra.settings, _settings(training)):
        log.logger.warning(f"{where}: the training continues, but its results will differ: {changed}")
    else:
        log.logger.info(f"{where}: the training continues as if it had never stopped")
    return tuple(extra.losses)


def _settings(training: Training) -> Settings:
    """Return the settings that affect the results of this training."""
    manner: dict[str, Any] = {
        "precision": training.options.precision,
        "exact": training.options.exact_sums,
        "device": training.device.type,
        "torch": torch.__version__,
    }
    if divided_sums(training.net):
        manner["threads"] = torch.get_num_threads()
    tests = {f"test net #{i}": net for i, net in enumerate(training.test_nets)}
    return settings_of(training.param, {nets.TRAIN_NET: training.net, **tests}, manner)


def _in_current_form(training: Training, state: State, where: Where) -> State:
    """Return a state with one history per parameter, from one with a history for each layer that shares it."""
    number = {id(learnable.parameter): i for i, learnable in enumerate(training.net.learnable)}
    owners = [number[id(blob)] for layer in training.net.layers for blob in layer.blobs]
    shapes = [shape for layer in training.net.layers for shape in layer.blob_shapes]
    if len(state.history) == len(training.history) or len(state.history) != training.rule.sets * len(owners):
        return state
    if len(state.history) == 2 * len(training.history) and has_squares(state.history, training.param.type):
        return state  # of another type: the second half is that type's second set
    for i, theirs in enumerate(state.history):
        mine = shapes[i % len(shapes)]
        if not _same_shape(mine, theirs.shape):
            raise SpecError(f"history blob {i} has shape {theirs.shape}, expected {mine}", where)
    message = "has a history for each layer, as before August 2015; the histories of shared parameters are added"
    log.warning("sgd_solver.cpp:336", f"{where}: {message}")
    return replace(state, history=merge_shared(state.history, owners))


def _same_shape(mine: tuple[int, ...], theirs: tuple[int, ...]) -> bool:
    """Return whether two shapes are equal, or the second is an old shape of four axes with leading ones."""
    return theirs == mine or theirs == (1,) * (4 - len(mine)) + mine
