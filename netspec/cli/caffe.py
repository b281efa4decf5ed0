"""``netspec train``, ``test`` and ``time``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from netspec import log
from netspec.cli.arguments import (
    add_engine,
    add_exact,
    add_gpu,
    add_iterations,
    add_limit,
    add_net,
    add_passes,
    add_phase,
    add_plugin,
    add_python,
    add_state,
    add_strict,
    devices,
    load,
    options,
    run_by,
    stages,
)
from netspec.cli.scores import Score, Scores
from netspec.errors import SpecError
from netspec.proto.binary import check_readable, split_paths
from netspec.terminal.commands import DONE, FAULT, WrongUsage
from netspec.terminal.parser import Commands

if TYPE_CHECKING:
    from netspec.solver.processes import Processes
    from netspec.solver.solver import Solver


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_train(commands)
    _add_test(commands)
    _add_time(commands)


BAR = "{n_fmt} of {total_fmt} |{bar}| {elapsed}, {remaining} left{postfix}"


def _add_train(commands: Commands) -> None:
    parser = commands.add_parser("train", _train, help="train or fine-tune a model (caffe train)")
    add_plugin(parser)
    add_limit(parser)
    parser.add_argument("path", nargs="?", metavar="SOLVER", help="the solver's prototxt")
    parser.add_argument("--solver", metavar="SOLVER", help="the solver's prototxt")
    parser.add_argument("--snapshot", metavar="SNAPSHOT", help="a .solverstate to resume from")
    parser.add_argument(
        "--resume", action="store_true", help="resume from the newest complete snapshot, if there is one"
    )
    parser.add_argument("--weights", metavar="WEIGHTS", help="weights to start from, several separated by commas")
    parser.add_output(
        "--scores", metavar="F.json", help="write the scores of each test and the names of the snapshots to this file"
    )
    parser.add_output(
        "--tensorboard",
        folder=True,
        metavar="DIR",
        help="write losses, learning rates and test outputs to this folder, for TensorBoard",
    )
    parser.add_argument(
        "--nan",
        default="stop",
        choices=["stop", "warn"],
        help="what to do when the loss is NaN or infinite (default: %(default)s)",
    )
    add_gpu(parser, text="number of the GPU, several separated by commas, or all (default: the device in the solver)")
    add_state(parser)
    parser.add_argument(
        "--sigint_effect",
        default="stop",
        choices=["stop", "snapshot", "none"],
        help="what Ctrl-C does (default: %(default)s); SIGTERM always stops",
    )
    parser.add_argument(
        "--sighup_effect",
        default="snapshot",
        choices=["stop", "snapshot", "none"],
        help="what SIGHUP does (default: %(default)s)",
    )
    add_python(parser)
    add_exact(parser)
    parser.add_argument(
        "--precision",
        default="fp32",
        choices=["fp32", "tf32", "bf16", "fp16"],
        help="precision of forward and backward passes; bf16 is faster on CPUs and GPUs that support it, fp16 on "
        "GPUs; both are less accurate (default: %(default)s)",
    )
    add_strict(parser)


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
        raise WrongUsage("under torchrun each process uses the GPU of its local rank; leave out --gpu")
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

    from netspec.cli.callbacks import ProgressBar, board, writer_class
    from netspec.solver.processes import Lost

    if arguments.tensorboard and processes.is_root:
        writer_class()  # a missing package is reported before the log of the nets

    effects = {
        signal.SIGINT: arguments.sigint_effect,
        signal.SIGTERM: "stop",
        signal.SIGHUP: arguments.sighup_effect,
    }
    with _signals(effects) as action:
        processes.is_ending = lambda: bool(action.stopped_by)
        solver = processes.together(lambda: _load(arguments, path, action, processes))
        log.info("caffe.cpp:239", "Starting Optimization")
        total, first = solver.param.max_iter, solver.iteration
        hidden = not sys.stderr.isatty() or not processes.is_root
        bar = tqdm(total=total, initial=first, bar_format=BAR, disable=hidden, leave=False)
        with bar, ExitStack() as stack:
            solver.callbacks.append(ProgressBar(solver, bar))
            if arguments.tensorboard and processes.is_root:
                solver.callbacks.append(stack.enter_context(board(solver, arguments.tensorboard)))
            try:
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
    from netspec.cli.callbacks import ScoresFile
    from netspec.proto.text import parse_solver
    from netspec.solver.options import TrainingOptions
    from netspec.solver.solver import make_solver
    from netspec.terminal.process import keep_freed_memory

    keep_freed_memory()
    param, node = parse_solver(path)
    if not param.HasField("max_iter"):
        raise SpecError(
            "has no max_iter, so there is nothing to train; add max_iter: N, the number of iterations", node.where
        )
    if arguments.resume and (found := _newest(param.snapshot_prefix)):
        arguments.snapshot, arguments.weights = str(found), None
    build = options(arguments, stages=stages(arguments, as_caffe=True))
    gpus = devices(arguments.gpu) if arguments.gpu else ()
    chosen = TrainingOptions(build, gpus, arguments.nan, arguments.precision, processes, action)
    solver = make_solver(param, node, chosen, arguments.weights, arguments.snapshot)
    if arguments.scores and processes.is_root:
        solver.callbacks.append(ScoresFile(solver, arguments.scores, resumed=bool(arguments.snapshot)))
    return solver


def _newest(prefix: str) -> Path | None:
    """Return the newest whole snapshot of a prefix; None, with a line in the log, where there is none."""
    from netspec.cli.resume import newest_pair

    found = newest_pair(prefix)
    if found is None:
        log.logger.info(f'no snapshot to resume from with the prefix "{prefix}": the training starts')
    return found


class _Signals:
    """What signals ask of a training: called between iterations, it returns the effect of one that came, or None.

    ``stopped_by`` is the number of the signal that asked to stop, 0 before. A second one that does ends the process at
    once.
    """

    def __init__(self) -> None:
        self.stopped_by = 0
        self._came: deque[str] = deque()

    def __call__(self) -> str | None:
        """Return the effect of the signal that came first, once."""
        return self._came.popleft() if self._came else None

    def receive(self, effect: str, number: int) -> None:
        """Note a signal that came."""
        if effect == "stop":
            if self.stopped_by:
                os._exit(128 + number)
            self.stopped_by = number
        self._came.append(effect)


@contextmanager
def _signals(effects: Mapping[signal.Signals, str]) -> Iterator[_Signals]:
    """Yield what receives the signals within the block, each with its effect: "stop", "snapshot" or "none"."""
    received = _Signals()
    before = {}
    for number, effect in effects.items():
        handler = signal.SIG_IGN if effect == "none" else lambda n, _, effect=effect: received.receive(effect, n)
        before[number] = signal.signal(number, handler)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _add_test(commands: Commands) -> None:
    parser = commands.add_parser("test", _test, help="score a model on its TEST-phase data (caffe test)")
    add_plugin(parser)
    add_limit(parser)
    add_net(parser)
    parser.add_argument("--weights", required=True, metavar="WEIGHTS", help="the trained weights")
    add_iterations(parser)
    parser.add_output("--scores", metavar="F.json", help="also write the mean scores to this file")
    add_gpu(parser)
    add_state(parser)
    add_python(parser)
    add_exact(parser)
    add_passes(parser)
    add_strict(parser)
    add_engine(parser)


def _test(arguments: argparse.Namespace) -> None:
    from netspec.inspect.check.measure import test_net
    from netspec.net.weights import load_weights

    check_readable(split_paths(arguments.weights))
    net = load(arguments, "TEST", "caffe.cpp:266", "caffe.cpp:275")
    load_weights(net, split_paths(arguments.weights), arguments.strict, need_one=True)
    net = run_by(net, arguments, arguments.weights)
    means = test_net(net, arguments.iterations)
    net.close()
    if arguments.scores:
        Scores([Score(None, 0, means)]).write(arguments.scores)


def _add_time(commands: Commands) -> None:
    parser = commands.add_parser("time", _time, help="measure the forward and backward time of each layer (caffe time)")
    add_plugin(parser)
    add_limit(parser)
    add_net(parser)
    add_iterations(parser)
    add_gpu(parser)
    add_phase(parser, default="TRAIN")
    add_state(parser)
    add_python(parser)
    add_exact(parser)
    add_engine(parser)


def _time(arguments: argparse.Namespace) -> None:
    from netspec.inspect.check.measure import time_forward, time_net

    arguments.passes = ()  # each layer is timed by itself
    net = load(arguments, arguments.phase, "caffe.cpp:340", "caffe.cpp:343", write_files=False)
    run_by(net, arguments, None)
    if net.runners[0] in (net.prepared, net.eager):  # an engine's kernels are not by layer
        time_net(net, arguments.iterations)
    else:
        time_forward(net, arguments.iterations)
    net.close()
