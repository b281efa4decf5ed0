"""Reads the log of a training, which ``caffe train`` and ``netspec train`` write to stderr.

Caffe: src/caffe/solver.cpp, src/caffe/solvers/sgd_solver.cpp; the messages differ slightly between versions.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from netspec.errors import SpecError, Where
from netspec.files.kinds import unreadable
from netspec.log import number
from netspec.terminal.output import INTERRUPTED, OUT_OF_MEMORY

_POINTS_OF_WINDOW = 25  # a curve is smoothed over this share of its points
_USUAL, _MANY = 98, 20  # the percentage of values to show, and the minimum number of values for it


@dataclass
class Curve:
    """Values at increasing iterations."""

    iterations: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.values)

    def add(self, iteration: int, value: float) -> None:
        """Add a value; it replaces the values of this and later iterations."""
        self.cut(iteration)
        self.iterations.append(iteration)
        self.values.append(value)

    def cut(self, iteration: int) -> None:
        """Remove the values from an iteration on, where a training was resumed."""
        if self.iterations and self.iterations[-1] >= iteration:
            end = bisect_left(self.iterations, iteration)
            del self.iterations[end:], self.values[end:]

    @property
    def last(self) -> float | None:
        """The last value, if there is any."""
        return self.values[-1] if self.values else None

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return iterations and values, float64 (n,)."""
        return np.array(self.iterations, float), np.array(self.values, float)


def smoothed(values: np.ndarray) -> np.ndarray:
    """Return the mean of a 25th of the values (n,) around each value, with fewer values near the ends.

    NaN and infinity are ignored; if nothing is left, the mean is NaN.
    """
    half = max(1, len(values) // _POINTS_OF_WINDOW) // 2
    known = np.isfinite(values)
    sums = np.concatenate([[0.0], np.cumsum(np.where(known, values, 0.0))])
    counts = np.concatenate([[0], np.cumsum(known)])
    places = np.arange(len(values))
    low, high = np.maximum(places - half, 0), np.minimum(places + half + 1, len(values))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (sums[high] - sums[low]) / (counts[high] - counts[low])


def thinned(x: np.ndarray, y: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return about ``most`` of the points (n,): the minimum and the maximum of each section."""
    if len(x) <= most:
        return x, y
    keep: set[int] = {0, len(x) - 1}
    for part in np.array_split(np.arange(len(x)), max(1, most // 2)):
        finite = part[np.isfinite(y[part])]
        if len(finite):
            keep |= {int(finite[np.argmin(y[finite])]), int(finite[np.argmax(y[finite])])}
    chosen = sorted(keep)
    return x[chosen], y[chosen]


def shown_range(curves: list[np.ndarray]) -> tuple[float, float] | None:
    """Return the minimum and maximum to draw for curves (n,); None if no value is finite.

    A few values far above the rest, which a loss often has at its start, are excluded.
    """
    finite = [values[np.isfinite(values)] for values in curves]
    finite = [values for values in finite if len(values)]
    if not finite:
        return None
    low = min(float(values.min()) for values in finite)
    most = max(float(values.max()) for values in finite)
    usual = max(float(np.percentile(values, _USUAL if len(values) >= _MANY else 100)) for values in finite)
    high = low + 1.6 * (usual - low)
    return (low, high) if most > low + 3 * (usual - low) > low else (low, most)


RUNNING, DONE, STOPPED, FAILED = "running", "done", "stopped early", "failed"

# `I1121 00:36:27.939015 12135 solver.cpp:239] ...`; newer versions of glog also write the year.
_COUNT = "([0-9]{1,10})(?![0-9])"  # an int of 32 bits
_PREFIX = re.compile(rf"([IWEF])(?:\d{{4}})?\d{{4}} \d\d:\d\d:\d\d\.\d{{6}} +{_COUNT} \S+?\] ?(.*)")
_LOSS = re.compile(rf"Iteration {_COUNT}[^=]*, loss = (\S+)")
_RATE = re.compile(rf"Iteration {_COUNT}, lr = (\S+)")
_TESTING = re.compile(rf"Iteration {_COUNT}, Testing net(?: \(#{_COUNT}\))?")
_OUTPUT = re.compile(rf"(Train|Test) net output #{_COUNT}: (.*) = (\S+?)(?: \(\* .* loss\))?$")
_SCORE = re.compile(rf"Test score #{_COUNT}: (\S+)")  # until 2014
_TEST_LOSS = re.compile(r"Test loss: (\S+)")
# Python's, a signal's, and netspec's own: `solver.prototxt:3:1: ...`.
_FAULT = re.compile(r"Traceback |\*\*\* .*SIG|\S[^:]*:\d+:\d+: ")
# What else a command of netspec ends with: `file: ...`. In a log with prefixes, such a line is an error only if the
# training does not go on: a net is printed without prefixes too, and so is what a Python layer prints.
_LAST_LINE = re.compile(rf"\S[^:]*: |\[Errno |{OUT_OF_MEMORY}")
_WINDOWS = {"1.#QNAN": "nan", "-1.#IND": "nan", "1.#INF": "inf", "-1.#INF": "-inf"}
_GREATEST = float(np.finfo(np.float32).max)


@dataclass
class TrainingLog:
    """The contents of a training's log.

    ``loss`` is averaged over ``average_loss`` iterations. ``train`` and ``tests`` are the outputs of the training net
    and, by index, of the test nets: name -> curve. For a blob with several values, the second is
    ``name[1]``. ``losses`` are the names of outputs that have a loss weight.
    """

    name: str
    loss: Curve = field(default_factory=Curve)
    rate: Curve = field(default_factory=Curve)
    train: dict[str, Curve] = field(default_factory=dict)
    tests: dict[int, dict[str, Curve]] = field(default_factory=dict)
    losses: set[str] = field(default_factory=set)
    state: str = RUNNING

    @property
    def iteration(self) -> int:
        """The last iteration in the log."""
        curves = (self.loss, self.rate, *(curve for net in self.tests.values() for curve in net.values()))
        return max((curve.iterations[-1] for curve in curves if len(curve)), default=0)

    def curves(self) -> list[Curve]:
        """Return all curves."""
        tests = [curve for net in self.tests.values() for curve in net.values()]
        return [self.loss, self.rate, *self.train.values(), *tests]


class LogReader:
    """Reads a log line by line into ``run``; a training resumed in the same log replaces repeated iterations."""

    def __init__(self, name: str) -> None:
        self.log = TrainingLog(name)
        self._position = 0  # the iteration of the last line
        self._net = 0  # the test net being tested
        self._has_prefixes = self._is_fatal = False
        self.begins = False  # whether the start of a training was read
        self._names: dict[tuple[str, int, int], tuple[str, str]] = {}

    def feed(self, line: str) -> None:
        """Read one line."""
        line = line.rstrip("\r\n")
        prefix = _PREFIX.search(line)
        if not prefix:
            self._read_without_prefix(line)
            return
        self._has_prefixes = True
        message = prefix[3]
        if message.startswith("Initializing solver from parameters"):
            self.log.state, self._is_fatal, self.begins = RUNNING, False, True
        elif prefix[1] == "I" and self.log.state == FAILED and not self._is_fatal:
            self.log.state = RUNNING
        self._read(message)
        if prefix[1] == "F":
            self.log.state, self._is_fatal = FAILED, True

    def _read_without_prefix(self, line: str) -> None:
        """Read a line of the program, or of a log that was written with GLOG_log_prefix=false."""
        if line == INTERRUPTED:
            self.log.state = STOPPED
        elif _FAULT.match(line) or (self._has_prefixes and self.log.state == RUNNING and _LAST_LINE.match(line)):
            self.log.state = FAILED
        else:
            self._read(line)

    def _read(self, message: str) -> None:
        log = self.log
        if found := _LOSS.search(message):
            log.loss.add(self._at(found[1]), _number(found[2]))
        elif found := _OUTPUT.search(message):
            self._output(found[1], int(found[2]), found[3], found[4], "loss)" in message)
        elif found := _RATE.search(message):
            log.rate.add(self._at(found[1]), _number(found[2]))
        elif found := _TESTING.search(message):
            self._at(found[1])
            self._net = int(found[2] or 0)
        elif found := _SCORE.search(message):
            self._output("Test", int(found[1]), f"score {found[1]}", found[2], False)
        elif found := _TEST_LOSS.match(message):
            self._output("Test", -1, "test loss", found[1], True)
        elif message.startswith("Optimization stopped early") or message == INTERRUPTED:
            log.state = STOPPED
        elif message.startswith("Optimization Done") and log.state == RUNNING:
            log.state = DONE

    def _at(self, text: str) -> int:
        """Return the iteration of a line; if it is before that of the last line, the training was resumed."""
        iteration = int(text)
        if iteration < self._position:
            for curve in self.log.curves():
                curve.cut(iteration)
        self._position = iteration
        return iteration

    def _output(self, phase: str, number: int, blob: str, value: str, is_loss: bool) -> None:
        net = self._net if phase == "Test" else -1
        place = (phase, net, number)
        if place not in self._names or self._names[place][0] != blob:
            before = sum(known[0] == blob for at, known in self._names.items() if at[:2] == place[:2] and at < place)
            self._names[place] = (blob, f"{blob}[{before}]" if before else blob)
        name = self._names[place][1]
        curves = self.log.train if net < 0 else self.log.tests.setdefault(net, {})
        curves.setdefault(name, Curve()).add(self._position, _number(value))
        if is_loss:
            self.log.losses.add(name)


def read_log(path: str | Path, name: str = "") -> TrainingLog:
    """Return the training in a log; one that failed before its first iteration has no curves.

    Raises SpecError if the file cannot be read or contains no training.
    """
    reader = LogReader(name or str(path))
    try:
        with open(path, encoding="utf-8", errors="replace", newline="\n") as file:
            for line in file:
                reader.feed(line)
    except OSError as fault:
        raise SpecError(unreadable(path, fault), Where(str(path))) from None
    failed_at_start = reader.begins and reader.log.state == FAILED
    if not failed_at_start and not any(len(curve) for curve in reader.log.curves()):
        advice = "expected what `netspec train` or `caffe train` writes to stderr (2> train.log), with display above 0"
        raise SpecError(f"contains no iteration of a training; {advice}", Where(str(path)))
    return reader.log


def _number(text: str) -> float:
    """Read a 32-bit float: larger values are infinite, and anything that is not a number is NaN."""
    try:
        value = float(_WINDOWS.get(text.rstrip(","), text.rstrip(",")))
    except ValueError:
        return math.nan
    return math.copysign(math.inf, value) if abs(value) > _GREATEST else value


_MOST_OUTPUTS = 6  # of each test net in a summary


def summary(log: TrainingLog) -> dict[str, str]:
    """Return by name: state, iterations, the last losses and test outputs, the minimum test loss."""
    found = {"state": "unfinished" if log.state == RUNNING else log.state, "iterations": f"{log.iteration:,}"}
    if log.loss.last is not None:
        found["last loss"] = number(log.loss.last)
    for net, curves in log.tests.items():
        label = "test" if len(log.tests) == 1 else f"test net {net}"
        for name, curve in list(curves.items())[:_MOST_OUTPUTS]:
            found[f"{label} {name}"] = number(curve.values[-1])
            finite = [value for value in curve.values if math.isfinite(value)]
            if name in log.losses and finite:
                least = min(finite)
                found[f"least {label} {name}"] = f"{number(least)} at {curve.iterations[curve.values.index(least)]:,}"
    return found
