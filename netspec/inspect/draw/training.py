"""Draws the curves of one or several trainings: losses, test outputs and learning rates."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from netspec.files.figures import COLORS, GRID
from netspec.inspect.draw.style import FAULT, STYLE
from netspec.inspect.logs.training_log import Curve, TrainingLog, shown_range, smoothed, thinned

WIDTH, LOSS_HEIGHT, HEIGHT = 9.0, 3.4, 2.3  # inches
MOST_POINTS = 2000  # maximum number of points of a curve
MOST_ELEMENTS = 6  # maximum number of values of an output blob; larger blobs are left out
LEGEND_WIDTH = 100  # characters
MARKERS = "osDv^<>"
MOST_MARKERS = 80  # maximum number of points in the width of the drawing
_DASHED = (0, (4, 2))


def training_figure(logs: Sequence[TrainingLog]) -> Figure:
    """Draw trainings in different colors: a panel for losses, one for each other output, and one for the rate.

    The training loss is drawn light, and its smoothed curve dark. Tests are dashed, with markers. The parts have ids
    in the SVG, such as ``run0-raw``. A test has a marker where the next is ``apart`` iterations or more away.
    """
    apart = max((log.iteration for log in logs), default=0) / MOST_MARKERS
    others = other_outputs(logs)
    rates = any(len(log.rate) for log in logs)
    heights = [LOSS_HEIGHT] + [HEIGHT] * (len(others) + rates)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
        panels: list[Axes] = list(
            figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights).flat
        )
        panels[0].set_title("loss")
        for number, log in enumerate(logs):
            _draw_losses(panels[0], log, number, apart)
        _scale_losses(panels[0], logs)
        for axis, name in zip(panels[1:], others, strict=False):
            axis.set_title(name, parse_math=False)
            for number, log in enumerate(logs):
                _draw_output(axis, log, name, number, apart)
        if rates:
            panels[-1].set_title("learning rate")
            for number, log in enumerate(logs):
                _draw_rate(panels[-1], log, number)
            _scale_rates(panels[-1], logs)
        for axis in panels:
            axis.grid(color=GRID, linewidth=0.6)
            axis.set_axisbelow(True)
            axis.margins(x=0.01)
        panels[-1].set_xlabel("iteration")
        panels[-1].xaxis.set_major_locator(MaxNLocator(9, integer=True, steps=[1, 2, 5, 10]))
        panels[-1].xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        _legend(figure, logs)
        return figure


def other_outputs(logs: Sequence[TrainingLog]) -> list[str]:
    """Return the outputs that get a panel: all except losses and the elements of long blobs."""
    found: dict[str, None] = {}
    for log in logs:
        for curves in (log.train, *log.tests.values()):
            names = [name for name in curves if name not in log.losses]
            for name in names:
                blob = name.partition("[")[0]
                if sum(other.partition("[")[0] == blob for other in names) <= MOST_ELEMENTS:
                    found[name] = None
    return list(found)


def _draw_losses(axis: Axes, log: TrainingLog, number: int, apart: float) -> None:
    x, y = _draw_train(axis, log.loss, number)
    bad = x[~np.isfinite(y)]
    if len(bad):
        marks = axis.plot(bad, np.full(len(bad), 0.02), "x", color=FAULT, transform=axis.get_xaxis_transform())
        marks[0].set_gid(f"run{number}-nan")
    for net, curves in log.tests.items():
        for name, curve in curves.items():
            if name in log.losses:
                _draw_test(axis, curve, number, net, apart)


def _draw_output(axis: Axes, log: TrainingLog, name: str, number: int, apart: float) -> None:
    if name not in log.losses and name in log.train:
        _draw_train(axis, log.train[name], number)
    for net, curves in log.tests.items():
        if name in curves and name not in log.losses:
            _draw_test(axis, curves[name], number, net, apart)


def _draw_train(axis: Axes, curve: Curve, number: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = curve.arrays()
    color = COLORS[number % len(COLORS)]
    _line(axis, x, y, f"run{number}-raw", color=color, linewidth=0.8, alpha=0.3)
    _line(axis, x, smoothed(y), f"run{number}-smooth", color=color, linewidth=1.6)
    return x, y


def _draw_test(axis: Axes, curve: Curve, number: int, net: int, apart: float) -> None:
    x, y = curve.arrays()
    marker = MARKERS[net % len(MARKERS)] if len(x) < 2 or np.median(np.diff(x)) >= apart else ""
    color = COLORS[number % len(COLORS)]
    _line(axis, x, y, f"run{number}-test", color=color, linestyle=_DASHED, linewidth=1.1, marker=marker, markersize=4)


def _draw_rate(axis: Axes, log: TrainingLog, number: int) -> None:
    x, y = log.rate.arrays()
    end = max(log.iteration, x[-1]) if len(x) else 0
    color = COLORS[number % len(COLORS)]
    _line(
        axis,
        np.append(x, end),
        np.append(y, y[-1:] if len(y) else 0),
        f"run{number}-rate",
        color=color,
        drawstyle="steps-post",
    )


def _line(axis: Axes, x: np.ndarray, y: np.ndarray, name: str, **options: object) -> None:
    x, y = thinned(x, np.where(np.isfinite(y), y, np.nan), MOST_POINTS)
    (line,) = axis.plot(x, y, **options)  # pyright: ignore[reportArgumentType]
    line.set_gid(name)


def _scale_losses(axis: Axes, logs: Sequence[TrainingLog]) -> None:
    """Show the whole range, except for a few outliers."""
    tests = [curves[name] for log in logs for curves in log.tests.values() for name in log.losses & set(curves)]
    curves = [curve.arrays()[1] for curve in [*(log.loss for log in logs), *tests]]
    found = shown_range(curves)
    if found is not None and found[1] > found[0]:
        margin = 0.05 * (found[1] - found[0])
        axis.set_ylim(found[0] - margin, found[1] + margin)


def _scale_rates(axis: Axes, logs: Sequence[TrainingLog]) -> None:
    """Use a logarithmic axis if rates differ by more than a factor of ten."""
    rates = [rate for log in logs for rate in log.rate.values if math.isfinite(rate) and rate > 0]
    if rates and max(rates) > 10 * min(rates):
        axis.set_yscale("log")
    elif rates:
        axis.set_ylim(0, 1.15 * max(rates))


def _legend(figure: Figure, logs: Sequence[TrainingLog]) -> None:
    handles = [Line2D([], [], color=COLORS[k % len(COLORS)], linewidth=2, label=log.name) for k, log in enumerate(logs)]
    gray = "#555555"
    handles.append(Line2D([], [], color=gray, linewidth=0.8, alpha=0.4, label="training, as logged"))
    handles.append(Line2D([], [], color=gray, linewidth=1.6, label="training, smoothed"))
    nets = sorted({net for log in logs for net in log.tests})
    for net in nets:
        label = "test" if len(nets) == 1 else f"test net {net}"
        marker = MARKERS[net % len(MARKERS)]
        handles.append(
            Line2D([], [], color=gray, linestyle=_DASHED, linewidth=1.1, marker=marker, markersize=4, label=label)
        )
    if any(not np.isfinite(log.loss.values).all() for log in logs if len(log.loss)):
        handles.append(Line2D([], [], color=FAULT, linestyle="", marker="x", label="loss is NaN or infinite"))
    for handle in handles:
        handle.set_label(textwrap.shorten(str(handle.get_label()), LEGEND_WIDTH, placeholder="..."))
    longest = max(len(str(handle.get_label())) for handle in handles)
    columns = max(1, min(len(handles), 4, LEGEND_WIDTH // (longest + 8)))
    legend = figure.legend(handles=handles, loc="outside upper left", ncols=columns, fontsize=9)
    for text in legend.get_texts():
        text.set_parse_math(False)
