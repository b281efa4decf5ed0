"""``netspec train``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from netspec import log
from netspec.cli.arguments import add_device, add_exact, add_python, add_state, add_strict, devices, options
from netspec.cli.run import BUILT, Commands, signals
from netspec.errors import SpecError
from netspec.inspect.logs.scores import Score, Scores, Snapshot, read_scores
from netspec.terminal.commands import DONE, FAULT, WrongUsage

if TYPE_CHECKING:
    from netspec.solver.processes import Processes
    from netspec.solver.solver import Solver

NAN = ("stop", "warn")
EFFECTS = ("stop", "snapshot", "none")
BAR = "{n_fmt} of {total_fmt} |{bar}| {elapsed}, {remaining} left{postfix}"


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("train", _train, "train or fine-tune a model (caffe train)", net=BUILT)
    p.add_argument("path", nargs="?", metavar="SOLVER", help="the solver's prototxt")
    p.add_argument("--solver", help="the solver's prototxt")
    p.add_argument("--snapshot", help="a .solverstate to resume from")
    p.add_argument("--resume", action="store_true", help="resume from the newest whole snapshot, if there is any")
    p.add_argument("--weights", help="weights to start from, several separated by commas")
    p.add_argument(
        "--scores", metavar="F.json", help="write the scores of each test and the snapshots taken to this file"
    )
    p.add_argument("--tensorboard", metavar="DIR", help="write losses, rates and test outputs here for TensorBoard")
    p.add_argument("--nan", choices=NAN, default="stop", help="what a loss of NaN or infinity does (default: stop)")
    add_device(p)
    add_state(p, phase=None)
    p.add_argument(
        "--sigint_effect", choices=EFFECTS, default="stop", help="what Ctrl-C does (default: stop); SIGTERM stops"
    )
    p.add_argument("--sighup_effect", choices=EFFECTS, default="snapshot", help="what SIGHUP does (default: snapshot)")
    add_python(p)
    add_exact(p)
    p.add_argument(
        "--precision",
        choices=("fp32", "tf32", "bf16", "fp16"),
        default="fp32",
        help="of the training net's passes; bf16 is faster on CPUs and GPUs that have it, fp16 on GPUs; both round "
        "more (default: fp32)",
    )
    add_strict(p)


def _train(arguments: argparse.Namespace) -> int:
    path = arguments.solver or arguments.path
    if not path or (arguments.solver and arguments.path):
        raise WrongUsage("need one solver definition: netspec train solver.prototxt")
    if arguments.snapshot and arguments.weights:
        raise WrongUsage("give a snapshot to resume training or weights to fine-tune, not both")
    if arguments.resume and arguments.snapshot:
        raise WrongUsage("--resume looks for the snapshot; leave out --snapshot")
    from netspec.solver.processes import FaultOfAll, Lost, Processes, join, started_by_torchrun

    if arguments.gpu and started_by_torchrun():
        raise WrongUsage("under torchrun each process takes the GPU of its number; leave out --gpu")
    processes = join() if started_by_torchrun() else Processes()
    status = DONE
    with nullcontext() if processes.is_root else log.silent():
        try:
            status = _solve(arguments, path, processes)
        except FaultOfAll:
            if processes.is_root:
                raise
            with suppress(Lost):  # the root reports it; torchrun ends all processes as soon as one has ended
                processes.gather(None)
            return FAULT
    if status == FAULT:  # another process is lost: leaving the group, and Python's own end, could wait for it
        sys.stderr.flush()
        os._exit(FAULT)
    processes.leave()
    return status


def _solve(arguments: argparse.Namespace, path: str, processes: Processes) -> int:
    """Train, and return the exit status."""
    from tqdm import tqdm

    from netspec.solver.board import writer_class
    from netspec.solver.processes import Lost

    if arguments.tensorboard and processes.is_root:
        writer_class()  # a missing package is reported before the log of the nets

    effects = {signal.SIGINT: arguments.sigint_effect, signal.SIGTERM: "stop"}
    if hasattr(signal, "SIGHUP"):  # Windows has none
        effects[signal.SIGHUP] = arguments.sighup_effect
    with signals(effects) as action:
        processes.is_ending = lambda: bool(action.stopped_by)
        solver = processes.together(lambda: _load(arguments, path, action, processes))
        log.info("caffe.cpp:239", "Starting Optimization")
        total, first = solver.param.max_iter, solver.iteration
        hidden = not sys.stderr.isatty() or not processes.is_root
        bar = tqdm(total=total, initial=first, bar_format=BAR, disable=hidden, leave=False)
        with _sole_writer(solver) if processes.is_root else nullcontext(), bar:
            solver.on_iteration = lambda: (bar.update(1), bar.set_postfix_str(f"loss {solver.loss:.4g}", refresh=False))
            board = _board(solver, arguments.tensorboard) if processes.is_root else nullcontext()
            try:
                with board:
                    solver.solve()
            except Lost as fault:  # reported here: torchrun ends this process as soon as signals work again
                kept = (
                    f"the last snapshot is {solver.last_snapshot}" if solver.last_snapshot else "no snapshot was taken"
                )
                print(f"{fault}; {kept}; start all processes again with --resume", file=sys.stderr)
                return FAULT
        solver.close()
    log.info("caffe.cpp:250", "Optimization Done.")
    return 128 + action.stopped_by if solver.stopped and action.stopped_by and not _as_caffe() else DONE


def _as_caffe() -> bool:
    """Say whether a training that a signal stopped is done, as in Caffe: for who calls it by a name of Caffe's.

    Under torchrun too, which answers any other status with a traceback.
    """
    from netspec.solver.processes import started_by_torchrun

    return Path(sys.argv[0]).stem in ("caffe", "train") or started_by_torchrun()


def _load(arguments: argparse.Namespace, path: str, action: Callable[[], str | None], processes: Processes) -> Solver:
    """Return the solver, resumed where that is asked for."""
    from netspec.process.heap import keep_freed_memory
    from netspec.proto.text import parse_solver
    from netspec.solver.options import TrainingOptions
    from netspec.solver.solver import make_solver

    keep_freed_memory()
    param, node = parse_solver(path)
    if not param.HasField("max_iter"):
        raise SpecError(
            "has no max_iter, so there is nothing to train; add max_iter: N, the number of iterations", node.where
        )
    if arguments.resume and (found := _newest(param.snapshot_prefix)):
        arguments.snapshot, arguments.weights = str(found), None
    build = options(arguments, stages=arguments.stage.split(","))  # without --stage an empty one, as in Caffe
    gpus = devices(arguments.gpu) if arguments.gpu else ()
    chosen = TrainingOptions(build, gpus, arguments.nan, arguments.precision, processes, action)
    solver = make_solver(path, chosen, arguments.weights, arguments.snapshot)
    if arguments.scores and processes.is_root:
        _keep_scores(solver, arguments.scores, resumed=bool(arguments.snapshot))
    return solver


def _newest(prefix: str) -> Path | None:
    """Return the newest whole snapshot of a prefix; None, with a line in the log, where there is none."""
    from netspec.solver.extra import newest_pair

    found = newest_pair(prefix)
    if found is None:
        log.logger.info(f'no snapshot to resume from with the prefix "{prefix}": the training starts')
    return found


def _sole_writer(solver: Solver) -> AbstractContextManager[None]:
    """Refuse a second training that would write snapshots of the same names."""
    from netspec.files.whole_file import has_locks, only_one
    from netspec.solver.checks import check_prefix

    if not (solver.param.snapshot or solver.param.snapshot_after_train):
        return nullcontext()
    check_prefix(solver.param, solver.node)
    prefix = solver.param.snapshot_prefix
    if not has_locks():
        log.logger.warning(f'no file locks here: nothing stops another training from writing over "{prefix}"')
    folder, name = os.path.split(prefix)
    lock = os.path.join(folder, f".{name}.lock")
    return only_one(lock, f'give each training a snapshot_prefix of its own, not "{prefix}" to both')


def _board(solver: Solver, folder: str | None) -> AbstractContextManager[object]:
    """Write for TensorBoard within the block, if a folder is given."""
    if not folder:
        return nullcontext()
    from netspec.solver.board import board

    return board(solver, folder)


def _keep_scores(solver: Solver, path: str, resumed: bool) -> None:
    """Make the solver write its scores; a resumed training keeps the earlier ones."""
    scores = read_scores(path).before(solver.iteration) if resumed and Path(path).exists() else Scores()
    scores.write(path)

    def tested(net: int) -> None:
        scores.tests.append(Score(solver.iteration, net, solver.scores[net]))
        scores.write(path)

    def saved(model: str) -> None:
        scores.snapshots.append(Snapshot(solver.iteration, model))
        scores.write(path)

    solver.on_test, solver.on_snapshot = tested, saved
