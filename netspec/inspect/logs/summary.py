"""A run in a few numbers."""

from __future__ import annotations

import math

from netspec.inspect.logs.run import RUNNING, Run
from netspec.log import number

_FEW = 6  # outputs of test nets that are told


def summary(run: Run) -> dict[str, str]:
    """Return, by name: state, iterations, the last losses and test outputs, the least test loss, iter/s."""
    told = {"state": "unfinished" if run.state == RUNNING else run.state, "iterations": f"{run.iteration:,}"}
    if run.loss.last is not None:
        told["last loss"] = number(run.loss.last)
    for net, curves in run.tests.items():
        label = run.test_label(net)
        for name, curve in list(curves.items())[:_FEW]:
            told[f"{label} {name}"] = number(curve.values[-1])
            finite = [value for value in curve.values if math.isfinite(value)]
            if name in run.losses and finite:
                least = min(finite)
                told[f"least {label} {name}"] = f"{number(least)} at {curve.iterations[curve.values.index(least)]:,}"
    speed = iterations_per_second(run)
    if speed:
        told["iter/s"] = number(float(f"{speed:.3g}"))
    return told


def iterations_per_second(run: Run, last: int = 0) -> float | None:
    """Return the speed by the stamps of the log's lines, tests included; over the ``last`` displays, or all (0)."""
    first = -last - 1 if last else 0
    iterations, seconds = run.times.iterations[first:], run.times.values[first:]
    if len(iterations) < 2 or seconds[-1] <= seconds[0]:
        return None
    return (iterations[-1] - iterations[0]) / (seconds[-1] - seconds[0])
