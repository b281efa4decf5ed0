"""What ``netspec watch`` shows of a training: a few lines, and the curve of its loss."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from netspec.errors import printable
from netspec.files.limits import amount
from netspec.inspect.logs.training_log import (
    FAILED,
    RUNNING,
    Curve,
    TrainingLog,
    iterations_per_second,
    shown_range,
    smoothed,
)
from netspec.log import number

_EMPTY = 0x2800
_DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))  # of a column, from the top
_MARK = "o"
_LABEL = 9  # characters left of the plot
_MOST_MARKS = 15


def plot_lines(
    curve: tuple[np.ndarray, np.ndarray], marks: tuple[np.ndarray, np.ndarray], width: int, height: int
) -> list[str]:
    """Return the lines of a plot, ``width`` x ``height`` characters: a curve of dots, and an ``o`` for each mark.

    Curve and marks are x and y, float64 (n,); values that are not finite are left out. Of the values that share a
    column of dots, the mean is drawn; of many marks some are.
    """
    points, others = _finite(*curve), _finite(*marks)
    others = tuple(each[:: -(-len(each) // _MOST_MARKS) or 1] for each in others)
    together = np.concatenate([points[1], others[1]])
    if not len(together):
        return []
    places = np.concatenate([points[0], others[0]])
    x0, x1 = float(places.min()), float(places.max())
    y0, y1 = shown_range([points[1], others[1]]) or (0.0, 0.0)
    y0, y1 = (y0, y1) if y1 > y0 else (y0 - 0.5, y0 + 0.5)
    columns, rows = max(10, width - _LABEL), max(2, height - 1)
    codes = np.full((rows, columns), _EMPTY)
    _draw(codes, points, (x0, x1, y0, y1))
    cells = [[chr(code) if code != _EMPTY else " " for code in line] for line in codes]
    for x, y in zip(*others, strict=True):
        down = rows - 1 - int(_scaled(np.array([np.clip(y, y0, y1)]), y0, y1, rows)[0])
        cells[down][int(_scaled(np.array([x]), x0, x1, columns)[0])] = _MARK
    return [*_with_labels(cells, y0, y1), _foot(x0, x1, columns)]


def _draw(codes: np.ndarray, points: tuple[np.ndarray, np.ndarray], ranges: tuple[float, float, float, float]) -> None:
    """Draw a line through the points into the characters' codes (rows, columns)."""
    rows, columns = codes.shape
    x0, x1, y0, y1 = ranges
    across = _scaled(points[0], x0, x1, 2 * columns)
    there = np.unique(across)
    if not len(there):
        return
    means = [points[1][across == column].mean() for column in there]
    line = np.arange(there[0], there[-1] + 1)
    heights = _scaled(np.clip(np.interp(line, there, means), y0, y1), y0, y1, 4 * rows)
    before = heights[0]
    for column, height in zip(line, heights, strict=True):
        for step in range(min(before, height), max(before, height) + 1) if abs(before - height) > 1 else (height,):
            down = 4 * rows - 1 - step
            codes[down // 4, column // 2] |= _DOTS[column % 2][down % 4]
        before = height


def bar(share: float, width: int) -> str:
    """Return a bar of ``width`` characters, of which ``share`` (0 to 1) is full."""
    full = round(min(max(share, 0.0), 1.0) * width)
    return "█" * full + "░" * (width - full)


def _finite(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = np.isfinite(y)
    return x[known], y[known]


def _scaled(values: np.ndarray, low: float, high: float, count: int) -> np.ndarray:
    """Return which of ``count`` cells each value falls into."""
    share = (values - low) / ((high - low) or 1.0)
    return np.minimum((share * count).astype(int), count - 1)


def _with_labels(cells: Sequence[Sequence[str]], low: float, high: float) -> list[str]:
    lines = []
    for row, line in enumerate(cells):
        value = high - (high - low) * (row + 0.5) / len(cells)
        named = row in (0, len(cells) // 2, len(cells) - 1)
        label = number(float(f"{value:.3g}")) if named else ""
        lines.append(f"{label:>{_LABEL - 2}} │" + "".join(line).rstrip())
    return lines


def _foot(first: float, last: float, columns: int) -> str:
    left, right = f"{first:,.0f}", f"{last:,.0f}"
    return " " * _LABEL + left + right.rjust(columns - len(left))


LOST = "not running"
_RECENT = 10  # displays by which the speed is told
_FEW = 6  # test outputs that are shown


def screen(
    log: TrainingLog, memory: tuple[int, int] | None, lost: bool, width: int, height: int, now: float
) -> list[str]:
    """Return the lines to show, at most ``height`` of at most ``width`` characters.

    ``memory`` is what the process takes now and took at most, in bytes. ``lost`` says that the log does not end, but
    nothing writes it any more. ``now`` is in seconds since 1970.
    """
    state = LOST if lost and log.state == RUNNING else log.state
    lines = [f"{log.name}: {state}", *_progress(log, state, width, now), *_scores(log), *_machine(log, memory)]
    if log.fault:
        lines.append(log.fault)
    lines.append("")
    values = smoothed(np.array(log.loss.values, float))
    rows = height - len(lines) - 2
    if rows >= 4:
        plot = plot_lines((np.array(log.loss.iterations, float), values), _test_losses(log), width, min(rows, 24))
        lines += [f"training loss, smoothed{'; o: test' if _test_losses(log)[0].size else ''}", *plot] if plot else []
    return [printable(line)[:width] for line in lines][:height]


def seconds_left(log: TrainingLog) -> float | None:
    """Return how long the training still takes, at its speed of late; None if that cannot be told."""
    speed = iterations_per_second(log, _RECENT)
    if log.max_iter is None or not speed or log.state != RUNNING:
        return None
    return max(0.0, (log.max_iter - log.iteration) / speed)


def duration(seconds: float) -> str:
    """Return a duration for people: ``2 d 3 h``, ``3 h 5 min``, ``5 min 7 s``, ``7 s``."""
    left = round(seconds)
    parts = []
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60), ("s", 1)):
        count, left = divmod(left, size)
        if count or (unit == "s" and not parts):
            parts.append(f"{count} {unit}")
    return " ".join(parts[:2])


def _progress(log: TrainingLog, state: str, width: int, now: float) -> list[str]:
    done = f"iteration {log.iteration:,}"
    if log.max_iter:
        share = log.iteration / log.max_iter
        done += f" of {log.max_iter:,}  {bar(share, max(10, min(40, width - 50)))} {100 * share:.0f} %"
    told = []
    if speed := iterations_per_second(log, _RECENT):
        told.append(f"{speed:.3g} iter/s")
    left = seconds_left(log)
    if left is not None and state == RUNNING:
        told.append(f"{duration(left)} left, until {_clock(now + left, now)}")
    elif state != RUNNING and len(log.times):
        told.append(f"took {duration(log.times.values[-1])}")
    return [done, ", ".join(told)] if told else [done]


def _clock(moment: float, now: float) -> str:
    there = time.localtime(moment)
    far = time.strftime("%Y-%m-%d", there) != time.strftime("%Y-%m-%d", time.localtime(now))
    return time.strftime("%Y-%m-%d %H:%M" if far else "%H:%M", there)


def _scores(log: TrainingLog) -> list[str]:
    told = []
    if log.loss.last is not None:
        told.append(f"loss {number(log.loss.last)}")
    if log.rate.last is not None:
        told.append(f"learning rate {number(log.rate.last)}")
    lines = [", ".join(told)] if told else []
    for net, curves in log.tests.items():
        values = [f"{name} {number(curve.values[-1])}" for name, curve in list(curves.items())[:_FEW] if len(curve)]
        at = max((curve.iterations[-1] for curve in curves.values() if len(curve)), default=0)
        if values:
            lines.append(f"{log.test_label(net)} at {at:,}: " + ", ".join(values))
    return lines


def _machine(log: TrainingLog, memory: tuple[int, int] | None) -> list[str]:
    told = []
    if log.waiting.last is not None:
        told.append(f"waiting for data {log.waiting.last:g} % of the time")
    if memory:
        told.append(f"memory {amount(memory[0])}, at most {amount(memory[1])}")
    if log.snapshots and log.state != FAILED:
        told.append(f"last snapshot at {log.snapshots[-1][0]:,}")
    return [", ".join(told)] if told else []


def _test_losses(log: TrainingLog) -> tuple[np.ndarray, np.ndarray]:
    """Return the losses of the first test net."""
    for curves in log.tests.values():
        for name, curve in curves.items():
            if name in log.losses:
                return curve.arrays()
    return Curve().arrays()


_TRAINERS = re.compile(rb"caffe|netspec|train")


def is_alive(process: int) -> bool | None:
    """Return whether a training with this process number runs; None where the system does not tell (no /proc)."""
    if not Path("/proc/self").exists():
        return None
    try:
        words = Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False
    return _TRAINERS.search(words) is not None  # else the number is another program's by now


def memory_of(process: int) -> tuple[int, int] | None:
    """Return the bytes of memory that a process takes now and took at most; None where the system does not tell."""
    try:
        text = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return None
    found = {name: int(size) << 10 for name, size in re.findall(r"^(VmRSS|VmHWM):\s+(\d+) kB", text, re.M)}
    return (found["VmRSS"], found["VmHWM"]) if len(found) == 2 else None
