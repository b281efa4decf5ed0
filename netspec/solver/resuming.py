"""Taking snapshots of a training, and resuming from them.

Caffe: Solver::Snapshot, Solver::Restore (src/caffe/solver.cpp), SGDSolver::RestoreSolverState (sgd_solver.cpp)
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
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
from netspec.solver.checks import bad_parameter, check_prefix, divided_sums
from netspec.solver.extra import (
    Extra,
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
from netspec.solver.testing import Tests
from netspec.solver.training import Training


class Snapshots:
    """Takes snapshots of a training, and restores them."""

    def __init__(self, training: Training, tests: Tests) -> None:
        self._training, self._tests = training, tests

    @contextmanager
    def sole_writer(self) -> Iterator[None]:
        """Within the block, refuse another process that would write snapshots of the same names, if this one will.

        Raises SpecError if there is one already, or if the snapshot_prefix is not writable.
        """
        training, param = self._training, self._training.param
        if not training.is_root or not (param.snapshot or param.snapshot_after_train):
            yield
            return
        check_prefix(param, training.node)
        folder, name = os.path.split(param.snapshot_prefix)
        lock = os.path.join(folder, f".{name}.lock")
        with only_one(lock, f'give each training a snapshot_prefix of its own, not "{param.snapshot_prefix}" to both'):
            yield

    def take(self) -> tuple[str, str]:
        """Write the weights and the state; return their paths, ``PREFIX_iter_N.caffemodel`` and ``.solverstate``.

        With ``snapshot_format: HDF5`` both end in ``.h5``. If there are several processes, the root writes them.
        Raises SpecError if they cannot be written.
        """
        training = self._training
        if training.options.nan == "stop" and bad_parameter(training.net):
            training.report_nan("the weights cannot be saved")
        hdf5 = training.param.snapshot_format == SolverParameter.SnapshotFormat.Value("HDF5")
        form, ending = ("HDF5", ".h5") if hdf5 else ("binary proto", "")
        stem = f"{training.param.snapshot_prefix}_iter_{training.iteration}"
        model, state = f"{stem}.caffemodel{ending}", f"{stem}.solverstate{ending}"
        states = self._running_states()
        if not training.is_root:
            training.last_snapshot = state
            return model, state
        log.info("solver.cpp:474" if hdf5 else "solver.cpp:464", f"Snapshotting to {form} file {model}")
        save_weights(training.net, model, training.param.snapshot_diff)
        site = "sgd_solver.cpp:296" if hdf5 else "sgd_solver.cpp:284"
        log.info(site, f"Snapshotting solver state to {form} file {state}")
        history = [values.cpu().numpy() for values in training.history]
        weights, settings = Digest.of(model), self._settings()
        write_state(
            state,
            State(training.iteration, model, training.current_step, history),
            before=lambda unfinished: write_extra(
                extra_path(state),
                Extra(
                    training.seed,
                    list(training.losses),
                    training.scale.state,
                    states,
                    settings,
                    weights,
                    Digest.of(unfinished),
                ),
            ),
        )
        training.last_snapshot = state
        for callback in training.callbacks:
            callback.on_snapshot(model)
        return model, state

    def _running_states(self) -> list[dict[str, dict[str, Any]]]:
        """Return the running state of each net; for test nets during a test, that from before the test."""
        training = self._training
        trained = [running_state(net) for net in (training.net, *training.replicas.nets)]
        tested = list(self._tests.states_before) or [running_state(net) for net in training.test_nets]
        return [state for states in training.options.processes.gather(trained) for state in states] + tested

    def restore(self, path: str | Path) -> None:
        """Resume from a .solverstate or .solverstate.h5, of Caffe or of netspec, and from its weights.

        With the file ``X.solverstate.extra`` next to it, the results are as if the training had never stopped. Without
        it, the data layers start again at their first record, as in Caffe. Raises SpecError, and changes nothing, if
        the state does not fit this solver's type and net.
        """
        training = self._training
        where = Where(str(path))
        extra = read_extra(path)
        state = self._in_current_form(read_state(path), where)
        if len(state.history) != len(training.history):
            found, expected = len(state.history), len(training.history)
            message = (
                f"incorrect length of history blobs: found {found}, expected {expected} for this net and solver type"
            )
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
        training.iteration = state.iteration
        training.current_step = state.current_step
        for net in (training.net, *training.test_nets):
            net.restart_data()
        training.replicas.restart_data()
        training.scale.resume([] if extra is None else extra.loss_scale)
        if extra is None:
            log.logger.info(f"{path} is from Caffe: the data starts at its first record, with different random numbers")
        else:
            self._resume_data(extra, Where(str(extra_path(path))))

    def _resume_data(self, extra: Extra, where: Where) -> None:
        """Restore the position in the data and the losses of the average."""
        training = self._training
        trained, rank = (training.net, *training.replicas.nets), training.options.processes.rank
        ranks = len(trained) * training.options.processes.count
        if len(extra.nets) != ranks + training.count_of_tests:
            expected = f"{ranks} of training and {training.count_of_tests} of testing"
            log.logger.warning(f"{where}: found {len(extra.nets)} nets, expected {expected}; the data starts again")
            return
        all_nets = (*trained, *training.test_nets)
        remembered = extra.nets[rank : rank + len(trained)] + extra.nets[ranks:][: len(training.test_nets)]
        try:
            for net, states in zip(all_nets, remembered, strict=True):
                resume(net, states)
        except SpecError as fault:
            raise SpecError(fault.message, where) from None
        training.losses_before = tuple(extra.losses)
        if extra.seed != training.seed:
            log.logger.warning(f"{where}: random_seed was {extra.seed}; the random numbers differ from here on")
        elif changed := changes(extra.settings, self._settings()):
            log.logger.warning(f"{where}: the training continues, but its results will differ: {changed}")
        else:
            log.logger.info(f"{where}: the training continues as if it had never stopped")

    def _settings(self) -> Settings:
        """Return the settings that affect the results of this training."""
        training = self._training
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

    def _in_current_form(self, state: State, where: Where) -> State:
        """Return a state with one history per parameter, from one with a history for each layer that shares it."""
        training = self._training
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
