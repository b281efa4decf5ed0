"""What ``netspec watch`` shows of a training: a few lines, and the curve of its loss."""

from __future__ import annotations

import time

import numpy as np

from netspec.errors import printable
from netspec.files.limits import amount
from netspec.inspect.logs.canvas import bar, plot_lines
from netspec.inspect.logs.curve import Curve, smoothed
from netspec.inspect.logs.run import FAILED, RUNNING, Run
from netspec.inspect.logs.summary import iterations_per_second
from netspec.log import number

LOST = "not running"
_RECENT = 10  # displays by which the speed is told
_FEW = 6  # test outputs that are shown


def screen(run: Run, memory: tuple[int, int] | None, lost: bool, width: int, height: int, now: float) -> list[str]:
    """Return the lines to show, at most ``height`` of at most ``width`` characters.

    ``memory`` is what the process takes now and took at most, in bytes. ``lost`` says that the log does not end, but
    nothing writes it any more. ``now`` is in seconds since 1970.
    """
    state = LOST if lost and run.state == RUNNING else run.state
    lines = [f"{run.name}: {state}", *_progress(run, state, width, now), *_scores(run), *_machine(run, memory)]
    if run.fault:
        lines.append(run.fault)
    lines.append("")
    values = smoothed(np.array(run.loss.values, float))
    rows = height - len(lines) - 2
    if rows >= 4:
        plot = plot_lines((np.array(run.loss.iterations, float), values), _test_losses(run), width, min(rows, 24))
        lines += [f"training loss, smoothed{'; o: test' if _test_losses(run)[0].size else ''}", *plot] if plot else []
    return [printable(line)[:width] for line in lines][:height]


def seconds_left(run: Run) -> float | None:
    """Return how long the training still takes, at its speed of late; None if that cannot be told."""
    speed = iterations_per_second(run, _RECENT)
    if run.max_iter is None or not speed or run.state != RUNNING:
        return None
    return max(0.0, (run.max_iter - run.iteration) / speed)


def duration(seconds: float) -> str:
    """Return a duration for people: ``2 d 3 h``, ``3 h 5 min``, ``5 min 7 s``, ``7 s``."""
    left = round(seconds)
    parts = []
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60), ("s", 1)):
        count, left = divmod(left, size)
        if count or (unit == "s" and not parts):
            parts.append(f"{count} {unit}")
    return " ".join(parts[:2])


def _progress(run: Run, state: str, width: int, now: float) -> list[str]:
    done = f"iteration {run.iteration:,}"
    if run.max_iter:
        share = run.iteration / run.max_iter
        done += f" of {run.max_iter:,}  {bar(share, max(10, min(40, width - 50)))} {100 * share:.0f} %"
    told = []
    if speed := iterations_per_second(run, _RECENT):
        told.append(f"{speed:.3g} iter/s")
    left = seconds_left(run)
    if left is not None and state == RUNNING:
        told.append(f"{duration(left)} left, until {_clock(now + left, now)}")
    elif state != RUNNING and len(run.times):
        told.append(f"took {duration(run.times.values[-1])}")
    return [done, ", ".join(told)] if told else [done]


def _clock(moment: float, now: float) -> str:
    there = time.localtime(moment)
    far = time.strftime("%Y-%m-%d", there) != time.strftime("%Y-%m-%d", time.localtime(now))
    return time.strftime("%Y-%m-%d %H:%M" if far else "%H:%M", there)


def _scores(run: Run) -> list[str]:
    told = []
    if run.loss.last is not None:
        told.append(f"loss {number(run.loss.last)}")
    if run.rate.last is not None:
        told.append(f"learning rate {number(run.rate.last)}")
    lines = [", ".join(told)] if told else []
    for net, curves in run.tests.items():
        values = [f"{name} {number(curve.values[-1])}" for name, curve in list(curves.items())[:_FEW] if len(curve)]
        at = max((curve.iterations[-1] for curve in curves.values() if len(curve)), default=0)
        if values:
            lines.append(f"{run.test_label(net)} at {at:,}: " + ", ".join(values))
    return lines


def _machine(run: Run, memory: tuple[int, int] | None) -> list[str]:
    told = []
    if run.waiting.last is not None:
        told.append(f"waiting for data {run.waiting.last:g} % of the time")
    if memory:
        told.append(f"memory {amount(memory[0])}, at most {amount(memory[1])}")
    if run.snapshots and run.state != FAILED:
        told.append(f"last snapshot at {run.snapshots[-1][0]:,}")
    return [", ".join(told)] if told else []


def _test_losses(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return the losses of the first test net."""
    for curves in run.tests.values():
        for name, curve in curves.items():
            if name in run.losses:
                return curve.arrays()
    return Curve().arrays()
