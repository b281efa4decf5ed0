"""``netspec watch``."""

from __future__ import annotations

import argparse
import math
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from netspec.cli.run import READ, Commands
from netspec.terminal.commands import DONE, WrongUsage, refuse

if TYPE_CHECKING:
    from netspec.inspect.logs.run import Follower

QUIET = 60.0  # seconds without a line after which a process that is not here counts as gone
_HOME, _CLEAR_LINE, _CLEAR_REST = "\x1b[H", "\x1b[K", "\x1b[J"
_NEW_SCREEN, _OLD_SCREEN = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add(
        "watch", _watch, "show a training in the terminal: curve, speed, time left, memory", quiet=True, net=READ
    )
    p.add_argument("log", nargs="?", metavar="LOG", help="the log of a training, which may still grow")
    p.add_argument("--solver", help="train this solver, with a log beside its snapshots, and watch it")
    p.add_argument("--every", type=float, default=1.0, metavar="SECONDS", help="how often to look (default: 1)")
    p.add_argument("--once", action="store_true", help="show the state once, and end")


def _watch(arguments: argparse.Namespace) -> int:
    from netspec.inspect.logs.run import Follower

    if bool(arguments.log) == bool(arguments.solver):
        raise WrongUsage("give the log of a training, or --solver to start one")
    if not 0 < arguments.every < math.inf:
        raise WrongUsage(f"found --every {arguments.every:g}, expected a number above 0")
    if arguments.once:
        refuse(arguments, ("solver", "every"), "is for following a training, not for --once")
    if arguments.solver:
        return _train(arguments)
    refuse(arguments, ("plugin",), "is for --solver; a log is read as it is")
    follower = Follower(arguments.log)
    follower.poll()
    if arguments.once or not sys.stdout.isatty():
        print("\n".join(_lines(follower)))
        return DONE
    _follow(follower, arguments.every)
    return DONE


def _train(arguments: argparse.Namespace) -> int:
    """Train in a process of its own, whose log goes to a file, and watch that."""
    from netspec.inspect.logs.run import Follower
    from netspec.proto.text import read_solver

    prefix = read_solver(arguments.solver).snapshot_prefix or str(Path(arguments.solver).with_suffix(""))
    log = Path(f"{prefix}.{time.strftime('%Y%m%d-%H%M%S')}.log")
    with log.open("xb") as file:
        words = [sys.executable, "-m", "netspec", "train", "--solver", arguments.solver]
        # Its own session: only a signal that is passed on reaches it, and it outlives a terminal that is closed.
        training = subprocess.Popen([*words, *_plugins(arguments)], stderr=file, start_new_session=True)
    try:
        _follow(Follower(log), arguments.every, training)
    except KeyboardInterrupt:
        training.send_signal(signal.SIGINT)
    status = training.wait()
    follower = Follower(log)
    follower.poll()
    print("\n".join(_lines(follower)))
    if 0 < status < 128:  # more: a signal stopped it
        print(log.read_text(errors="replace").splitlines()[-1], file=sys.stderr)
    print(log)
    return status


def _plugins(arguments: argparse.Namespace) -> list[str]:
    return [word for plugin in arguments.plugin for word in ("--plugin", plugin)]


def _follow(follower: Follower, every: float, training: subprocess.Popen[bytes] | None = None) -> None:
    """Show a log as it grows, until the training ends, on a screen that is given back then."""
    from netspec.inspect.logs.run import RUNNING

    shown = sys.stdout.isatty()
    if shown:
        sys.stdout.write(_NEW_SCREEN)
    try:
        while True:
            follower.poll()
            if shown:
                text = "".join(f"{line}{_CLEAR_LINE}\n" for line in _lines(follower))
                sys.stdout.write(_HOME + text.rstrip("\n") + _CLEAR_REST)
                sys.stdout.flush()
            if follower.run.state != RUNNING or (training is not None and training.poll() is not None):
                return
            time.sleep(every)
    finally:
        if shown:
            sys.stdout.write(_OLD_SCREEN)
            if training is None:
                print("\n".join(_lines(follower)))


def _lines(follower: Follower) -> list[str]:
    from netspec.inspect.logs.screen import is_alive, memory_of, screen

    run, now = follower.run, time.time()
    alive = is_alive(run.process) if run.process is not None else None
    size = shutil.get_terminal_size((100, 40))
    memory = memory_of(run.process) if alive and run.process is not None else None
    lost = alive is False and now - follower.changed > QUIET  # else it may run on another machine
    return screen(run, memory, lost, size.columns, size.lines, now)
