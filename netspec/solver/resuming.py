"""Snapshots of a training, and how it goes on from one.

Caffe: Solver::Snapshot, Solver::Restore (src/caffe/solver.cpp), SGDSolver::RestoreSolverState (sgd_solver.cpp)
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from netspec import log
from netspec.errors import SpecError, Where
from netspec.net.stamp import Stamp
from netspec.net.weights import load_weights, save_weights
from netspec.proto.schema import SolverParameter
from netspec.solver import nets
from netspec.solver.extra import Extra, check_pair, path_beside, read_extra, resume, running_state, write_extra
from netspec.solver.nan import bad_parameter
from netspec.solver.settings import Settings, changes, settings_of
from netspec.solver.snapshot import State, find_learned_net, has_squares, merge_shared, read_state, write_state
from netspec.solver.threads import divided_sums
from netspec.solver.training import Training


class Resumable(Training):
    """A training that takes snapshots, and goes on from them."""

    def snapshot(self) -> tuple[str, str]:
        """Write the weights and the state; return their paths, ``PREFIX_iter_N.caffemodel`` and ``.solverstate``.

        With ``snapshot_format: HDF5`` both end in ``.h5``. Of several processes the root writes them.
        Raises SpecError if they cannot be written.
        """
        if self.options.nan == "stop" and bad_parameter(self.net):
            self.tell_nan("the weights cannot be saved")
        hdf5 = self.param.snapshot_format == SolverParameter.SnapshotFormat.Value("HDF5")
        form, ending = ("HDF5", ".h5") if hdf5 else ("binary proto", "")
        stem = f"{self.param.snapshot_prefix}_iter_{self.iteration}"
        model, state = f"{stem}.caffemodel{ending}", f"{stem}.solverstate{ending}"
        states = self._running_states()
        if not self.options.processes.is_root:
            self.last_snapshot = state
            return model, state
        log.info("solver.cpp:474" if hdf5 else "solver.cpp:464", f"Snapshotting to {form} file {model}")
        save_weights(self.net, model, self.param.snapshot_diff)
        site = "sgd_solver.cpp:296" if hdf5 else "sgd_solver.cpp:284"
        log.info(site, f"Snapshotting solver state to {form} file {state}")
        history = [values.cpu().numpy() for values in self.history]
        weights, settings = Stamp.of(model), self._settings()
        write_state(
            state,
            State(self.iteration, model, self.current_step, history),
            before=lambda unfinished: write_extra(
                path_beside(state),
                Extra(self.seed, list(self.losses), states, settings, weights, Stamp.of(unfinished)),
            ),
        )
        self.last_snapshot = state
        self.on_snapshot(model)
        return model, state

    def _running_states(self) -> list[dict[str, dict[str, Any]]]:
        """Return what each net remembers. During a test, test nets' are as before: it is run again after a resume."""
        training = [running_state(net) for net in (self.net, *self.replicas.nets)]
        testing = list(self.states_before_test) or [running_state(net) for net in self.test_nets]
        return [state for states in self.options.processes.gather(training) for state in states] + testing

    def restore(self, path: str | Path) -> None:
        """Resume from a .solverstate or .solverstate.h5, of Caffe or of netspec, and from its weights.

        With the file ``X.solverstate.extra`` beside it the training goes on as if it had never stopped; without it, as
        in Caffe, the data layers start again at their first record. Raises SpecError, and changes nothing, if the state
        does not fit this solver's type and net.
        """
        where = Where(str(path))
        extra = read_extra(path)
        state = self._of_today(read_state(path), where)
        if len(state.history) != len(self.history):
            found, expected = len(state.history), len(self.history)
            message = (
                f"incorrect length of history blobs: found {found}, expected {expected} for this net and solver type"
            )
            raise SpecError(f"{message} {self.param.type}", where)
        for i, (mine, theirs) in enumerate(zip(self.history, state.history, strict=True)):
            if not _same_shape(tuple(mine.shape), theirs.shape):
                raise SpecError(f"history blob {i} has shape {theirs.shape}, expected {tuple(mine.shape)}", where)
        learned_net = find_learned_net(state, path)
        if extra is not None:
            check_pair(path, learned_net, extra)
        load_weights(self.net, learned_net, strict=True)
        log.info("sgd_solver.cpp:336", "SGDSolver: restoring history")
        for mine, theirs in zip(self.history, state.history, strict=True):
            mine.copy_(torch.tensor(theirs).view(mine.shape))
        self.iteration = state.iteration
        self.current_step = state.current_step
        for net in (self.net, *self.test_nets):
            net.restart_data()
        self.replicas.restart_data()
        if extra is None:
            log.logger.info(f"{path} is Caffe's: the data starts again at its first record, with other random numbers")
        else:
            self._go_on(extra, Where(str(path_beside(path))))

    def _go_on(self, extra: Extra, where: Where) -> None:
        """Go on in the data where a training stopped, with the losses of its average."""
        training, rank = (self.net, *self.replicas.nets), self.options.processes.rank
        ranks = len(training) * self.options.processes.count
        if len(extra.nets) != ranks + self.count_of_tests:
            expected = f"{ranks} of training and {self.count_of_tests} of testing"
            log.logger.warning(f"{where}: is of {len(extra.nets)} nets, not {expected}: the data starts again")
            return
        all_nets = (*training, *self.test_nets)
        remembered = extra.nets[rank : rank + len(training)] + extra.nets[ranks:][: len(self.test_nets)]
        try:
            for net, states in zip(all_nets, remembered, strict=True):
                resume(net, states)
        except SpecError as fault:
            raise SpecError(fault.message, where) from None
        self.losses_before = tuple(extra.losses)
        if extra.seed != self.seed:
            log.logger.warning(f"{where}: random_seed was {extra.seed}: the random numbers are others from here on")
        elif told := changes(extra.settings, self._settings()):
            log.logger.warning(f"{where}: the training goes on with other numbers: {told}")
        else:
            log.logger.info(f"{where}: the training goes on as if it had never stopped")

    def _settings(self) -> Settings:
        """Return what the numbers of this training follow from."""
        manner: dict[str, Any] = {
            "precision": self.options.precision,
            "exact": self.exact,
            "device": self.device.type,
            "torch": torch.__version__,
        }
        if divided_sums(self.net):
            manner["threads"] = torch.get_num_threads()
        tests = {f"test net #{i}": net for i, net in enumerate(self.test_nets)}
        return settings_of(self.param, {nets.TRAIN_NET: self.net, **tests}, manner)

    def _of_today(self, state: State, where: Where) -> State:
        """Return a state in today's form, where it has a history for each layer that shares a parameter."""
        number = {id(learnable.parameter): i for i, learnable in enumerate(self.net.learnable)}
        owners = [number[id(blob)] for layer in self.net.layers for blob in layer.blobs]
        shapes = [shape for layer in self.net.layers for shape in layer.blob_shapes]
        if len(state.history) == len(self.history) or len(state.history) != self.rule.sets * len(owners):
            return state
        if len(state.history) == 2 * len(self.history) and has_squares(state.history, self.param.type):
            return state  # not of this type: the second half is another type's second set
        for i, theirs in enumerate(state.history):
            mine = shapes[i % len(shapes)]
            if not _same_shape(mine, theirs.shape):
                raise SpecError(f"history blob {i} has shape {theirs.shape}, expected {mine}", where)
        told = "has a history for each layer, as before August 2015; those of shared parameters are added up"
        log.warning("sgd_solver.cpp:336", f"{where}: {told}")
        return replace(state, history=merge_shared(state.history, owners))


def _same_shape(mine: tuple[int, ...], theirs: tuple[int, ...]) -> bool:
    """Return whether two shapes are equal, or theirs is an old shape of four axes, with ones in front."""
    return theirs == mine or theirs == (1,) * (4 - len(mine)) + mine
