"""``netspec data``, ``plot`` and ``watch``."""

from __future__ import annotations

import argparse
import json
import math
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from netspec.errors import printable
from netspec.terminal.commands import DONE, FAULT, WrongUsage, refuse
from netspec.terminal.output import bar

if TYPE_CHECKING:
    from netspec.data.records import Records
    from netspec.data.survey import Survey
    from netspec.inspect.logs.training_log import Follower

TABLE = """
data quiet                         look at a database: a sheet of its records, or its statistics
  what {show|stat}                 show: draw records, labels, statistics; stat: print statistics
  source DB                        an LMDB, a LevelDB, an HDF5 file, or a list of HDF5 files
  --records N                      look at N records, evenly spread (default: all)
  --out F.png|svg                  show: the picture to write
  --count=40 N                     show: how many records to draw (default: 40)
  --start K                        show: draw the records from number K on (default: a spread)
  --images N                       show: images side by side in a record (default: 2 of 2 or 6 channels)
  --json                           stat: print JSON
plot quiet                         draw the curves of trainings from their logs, netspec's or Caffe's
  logs... LOG                      what a training wrote to stderr
  --out! F.png|svg|html            the picture, or a page, to write
  --names NAMES,...                what the logs are called, separated by commas (default: the names of the files)
  --smooth N                       average N points (default: a 25th of them)
  --log_scale                      draw losses on a logarithmic axis
watch quiet read                   show a training in the terminal: curve, speed, time left, memory
  [log] LOG                        the log of a training, which may still grow
  --solver SOLVER                  train this solver, with a log beside its snapshots, and watch it
  --every=1 SECONDS                how often to look (default: 1)
  --once                           show the state once, and end
"""


SHOW, STAT = "show", "stat"
SHOWN_FAULTS = 4  # which come first


def _data(arguments: argparse.Namespace) -> int:
    from netspec.data.records import open_records, spread
    from netspec.data.survey import survey

    if arguments.what == SHOW:
        refuse(arguments, ("json",), "is for `data stat`")
        if not arguments.out:
            raise WrongUsage("`data show` needs --out F.png")
    else:
        refuse(arguments, ("out", "count", "start", "images"), "is for `data show`")
    records = open_records(arguments.source)
    if arguments.start is not None and not 0 <= arguments.start < len(records):
        raise WrongUsage(f"found --start {arguments.start}, expected 0 to {len(records) - 1}")
    found = survey(records, spread(len(records), arguments.records), partial(bar, stage="look", unit="record"))
    if arguments.what == STAT:
        return _tell_survey(arguments, found)
    _show(arguments, records, found)
    return DONE


def _tell_survey(arguments: argparse.Namespace, found: Survey) -> int:
    from netspec.data.survey import as_json, as_lines

    if arguments.json:
        print(json.dumps(as_json(found)))
    else:
        print("\n".join(printable(line) for line in as_lines(found, arguments.source)))
    for fault in found.faults:
        print(printable(f'{arguments.source}: record "{fault.key}" {fault.text}'), file=sys.stderr)
    if found.num_faults > len(found.faults):
        print(f"and {found.num_faults - len(found.faults):,} more", file=sys.stderr)
    return FAULT if found.num_faults else DONE


def _show(arguments: argparse.Namespace, records: Records, found: Survey) -> None:
    from netspec.data.records import spread
    from netspec.inspect.draw.sheet import sheet
    from netspec.inspect.draw.style import ending_of, write_figure

    ending_of(arguments.out, ("png", "svg"))
    if arguments.start is None:
        faulty = [fault.number for fault in found.faults[:SHOWN_FAULTS]]
        numbers = faulty + [k for k in spread(len(records), arguments.count) if k not in faulty][: -len(faulty) or None]
    else:
        numbers = list(range(arguments.start, min(arguments.start + arguments.count, len(records))))
    write_figure(sheet([records[k] for k in numbers], found, arguments.source, arguments.images), arguments.out)
    print(f"{arguments.out}: {len(numbers)} of {len(records):,} records")


def _plot(arguments: argparse.Namespace) -> None:
    from netspec.files.whole_file import write_whole
    from netspec.inspect.draw.style import ending_of, write_figure
    from netspec.inspect.draw.training import Look, training_figure
    from netspec.inspect.draw.training_page import training_page
    from netspec.inspect.logs.training_log import read_log, summary

    names = [printable(name) for name in (arguments.names.split(",") if arguments.names else _names(arguments.logs))]
    if len(names) != len(arguments.logs):
        raise WrongUsage(f"found {len(names)} --names and {len(arguments.logs)} logs, expected equal numbers")
    ending = ending_of(arguments.out)
    logs = [read_log(path, name) for path, name in zip(arguments.logs, names, strict=True)]
    figure = training_figure(logs, Look(arguments.smooth, arguments.log_scale))
    if ending == "html":
        write_whole(arguments.out, training_page(logs, figure, ", ".join(names)))
    else:
        write_figure(figure, arguments.out)
    for log in logs:
        print(f"{log.name}: " + ", ".join(f"{name} {value}" for name, value in summary(log).items()))
    print(arguments.out)


def _names(paths: list[str]) -> list[str]:
    """Return the files' names, with as many folders as needed to tell them apart."""
    parts = [Path(path).parts for path in paths]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(each[-length:]) for each in parts]
        if len(set(names)) == len(set(paths)):
            return names
    return list(paths)


QUIET = 60.0  # seconds without a line after which a process that is not here counts as gone
_HOME, _CLEAR_LINE, _CLEAR_REST = "\x1b[H", "\x1b[K", "\x1b[J"
_NEW_SCREEN, _OLD_SCREEN = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"


def _watch(arguments: argparse.Namespace) -> int:
    from netspec.inspect.logs.training_log import Follower

    if bool(arguments.log) == bool(arguments.solver):
        raise WrongUsage("give the log of a training, or --solver to start one")
    if not 0 < arguments.every < math.inf:
        raise WrongUsage(f"found --every {arguments.every:g}, expected a number above 0")
    if arguments.once:
        refuse(arguments, ("solver", "every"), "is for following a training, not for --once")
    if arguments.solver:
        return _watch_own(arguments)
    refuse(arguments, ("plugin",), "is for --solver; a log is read as it is")
    follower = Follower(arguments.log)
    follower.poll()
    if arguments.once or not sys.stdout.isatty():
        print("\n".join(_lines(follower)))
        return DONE
    _follow(follower, arguments.every)
    return DONE


def _watch_own(arguments: argparse.Namespace) -> int:
    """Train in a process of its own, whose log goes to a file, and watch that."""
    from netspec.inspect.logs.training_log import Follower
    from netspec.proto.text import read_solver

    prefix = read_solver(arguments.solver).snapshot_prefix or str(Path(arguments.solver).with_suffix(""))
    log = Path(f"{prefix}.{time.strftime('%Y%m%d-%H%M%S')}.log")
    with log.open("xb") as file:
        words = [sys.executable, "-m", "netspec", "train", "--solver", arguments.solver]
        words += [word for plugin in arguments.plugin for word in ("--plugin", plugin)]
        # Its own session: only a signal that is passed on reaches it, and it outlives a terminal that is closed.
        training = subprocess.Popen(words, stderr=file, start_new_session=True)
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


def _follow(follower: Follower, every: float, training: subprocess.Popen[bytes] | None = None) -> None:
    """Show a log as it grows, until the training ends, on a screen that is given back then."""
    from netspec.inspect.logs.training_log import RUNNING

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
            if follower.log.state != RUNNING or (training is not None and training.poll() is not None):
                return
            time.sleep(every)
    finally:
        if shown:
            sys.stdout.write(_OLD_SCREEN)
            if training is None:
                print("\n".join(_lines(follower)))


def _lines(follower: Follower) -> list[str]:
    from netspec.inspect.logs.screen import is_alive, memory_of, screen

    log, now = follower.log, time.time()
    alive = is_alive(log.process) if log.process is not None else None
    size = shutil.get_terminal_size((100, 40))
    memory = memory_of(log.process) if alive and log.process is not None else None
    lost = alive is False and now - follower.changed > QUIET  # else it may run on another machine
    return screen(log, memory, lost, size.columns, size.lines, now)
