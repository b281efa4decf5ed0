"""Draws the pictures of the reports with Matplotlib: matrices, precision-recall curves, maps, matches, paths.

pyplot is not used, because it would choose a backend for the whole program. Names of methods and data sets are drawn
with ``parse_math=False``, so that a dollar sign in them does not start a formula.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from loopclosure.closing.close import Closed, aligned
from loopclosure.evaluation import WIDE, Evaluation, Outcome
from loopclosure.places.truth import Truth
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH
from netspec.errors import printable
from netspec.files import figures
from netspec.files.figures import COLORS
from netspec.files.whole_file import write_whole

FOUND, FALSE, MISSED, NEARLY = "#1a9641", "#d7191c", "#9e9e9e", "#f4a582"
LINES = ("-", "--", ":", "-.")  # the second use of a color is dashed, and so on
TITLE_WIDTH = 38  # characters that fit above a panel
LABEL_WIDTH = 60  # characters that fit in a line of a legend
LABELS_HEIGHT = 0.5  # inches for the tick labels and the label of the horizontal axis
NOT_JUDGED = "#ececec"
# A matrix with more rows or columns is reduced to the maximum of each block, so that thin loops stay visible.
SHOWN_CELLS = 700
COLUMNS = 4

STYLE: dict[Any, Any] = {
    **figures.STYLE,
    "font.size": 9,
    "axes.titlesize": 9,
    "figure.dpi": 160,
    "savefig.bbox": "tight",
}


def matrices(evaluation: Evaluation) -> Figure:
    """Draw the truth and the scores of every method (the paper's Figures 5 and 6)."""
    truth = evaluation.data.truth
    panels = 1 + len(evaluation.outcomes)
    with matplotlib.rc_context(STYLE):
        figure, axes = _grid(panels, 1.0 if truth.hard.shape[0] == truth.hard.shape[1] else 0.9)
        shown = np.where(truth.hard, 2.0, np.where(truth.soft, 1.0, 0.0))
        _draw_matrix(axes[0], np.where(truth.judged, shown, np.nan), ListedColormap(["white", NEARLY, "black"]), 0, 2)
        axes[0].set_title("ground truth")
        for axis, outcome in zip(axes[1:], evaluation.outcomes, strict=True):
            scores = np.where(truth.judged & np.isfinite(outcome.scores), outcome.scores, np.nan)
            some = scores[np.isfinite(scores)]
            low, high = np.percentile(some, [1, 99.5]) if len(some) else (0.0, 1.0)
            _draw_matrix(axis, scores, matplotlib.colormaps["viridis"], float(low), float(high))
            _name_panel(axis, outcome)
        references = "earlier frame" if evaluation.data.references is None else "reference"
        for axis in axes:
            axis.set_xlabel(references)
        _label_left(axes, "frame" if references == "earlier frame" else "query")
        _state_truth(figure, evaluation)
        return figure


def curves(evaluation: Evaluation) -> Figure:
    """Draw the precision-recall curves of all methods, one panel for each convention.

    With poses, a third panel has the best match of each query by the wide angle.
    """
    panels = {
        ALL_PAIRS: [outcome.pairs for outcome in evaluation.outcomes],
        BEST_MATCH: [outcome.best for outcome in evaluation.outcomes],
        BEST_MATCH + WIDE: [outcome.wide.best for outcome in evaluation.outcomes if outcome.wide is not None],
    }
    panels = {title: found for title, found in panels.items() if found}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.8 * len(panels), 4.2), layout="constrained")
        axes = figure.subplots(1, len(panels))
        for axis, (title, found) in zip(axes, panels.items(), strict=True):
            for number, (outcome, curve) in enumerate(zip(evaluation.outcomes, found, strict=True)):
                points = np.append(0.0, curve.recall), np.append(curve.precision[:1], curve.precision)
                draw_curve(axis, *points, outcome.name, number, curve.average_precision)
            if title == ALL_PAIRS:
                curve = evaluation.outcomes[0].pairs
                axis.axhline(curve.positives / max(curve.samples, 1), color="#888888", linewidth=0.7, linestyle=":")
            frame_curves(axis, title)
        legends_below(figure, axes)
        _state_truth(figure, evaluation)
        return figure


def frame_curves(axis: Axes, title: str) -> None:
    """Set the title, the labels and the limits of a panel of precision-recall curves."""
    axis.set_title(title)
    axis.set_xlabel("recall")
    axis.set_ylabel("precision")
    axis.set_xlim(-0.01, 1.01)
    axis.set_ylim(0, 1.03)
    axis.grid(color=figures.GRID, linewidth=0.5)


def matches(evaluation: Evaluation) -> Figure:
    """Draw for each method the found, false and missed loops, frame against frame, over the truth."""
    with matplotlib.rc_context(STYLE):
        figure, axes = _grid(len(evaluation.outcomes), 1.0)
        for axis, outcome in zip(axes, evaluation.outcomes, strict=True):
            _draw_matches(axis, outcome, evaluation.data.truth)
            _name_panel(axis, outcome)
        _label_left(axes, "query")
        _loop_legend(figure)
        _state_truth(figure, evaluation, BEST_MATCH)
        return figure


def has_map(evaluation: Evaluation) -> bool:
    """Return whether the loops can be drawn on a trajectory: one sequence with positions."""
    return evaluation.data.positions is not None and evaluation.data.references is None


def maps(evaluation: Evaluation) -> Figure:
    """Draw for each method the found, false and missed loops as lines on the trajectory."""
    positions = evaluation.data.positions
    assert positions is not None
    with matplotlib.rc_context(STYLE):
        figure, axes = _grid(len(evaluation.outcomes), 1.0)
        for axis, outcome in zip(axes, evaluation.outcomes, strict=True):
            _draw_map(axis, outcome, evaluation.data.truth, positions)
            _name_panel(axis, outcome)
        _loop_legend(figure)
        _state_truth(figure, evaluation, BEST_MATCH)
        return figure


def decisions(outcome: Outcome, truth: Truth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the numbers of the queries found, false and missed, by their best matches.

    They are what the method accepted, or what it would accept at the threshold of its best F1 if it does not decide.
    A query that has a loop but a wrong match is both false and missed, and is drawn as both.
    """
    least = -np.inf if outcome.answer else outcome.best.best_f1_threshold
    accepted = (outcome.matches.reference >= 0) & (outcome.matches.score >= least)
    found = accepted & outcome.matches.right
    false = accepted & ~outcome.matches.right & ~outcome.matches.ignored
    missed = truth.queries_with_a_loop & ~found
    return np.flatnonzero(found), np.flatnonzero(false), np.flatnonzero(missed)


def best_true_references(outcome: Outcome, truth: Truth, queries: np.ndarray) -> np.ndarray:
    """Return the true reference with the best score for each of these queries; all of them must have a loop."""
    scores = np.where(truth.hard[queries] & truth.judged[queries], outcome.scores[queries], np.nan)
    scores = np.where(np.isnan(scores), np.where(truth.hard[queries] & truth.judged[queries], -np.inf, np.nan), scores)
    return np.nanargmax(scores, axis=1)


def _draw_matrix(axis: Axes, values: np.ndarray, colors: Colormap, low: float, high: float) -> None:
    rows, columns = values.shape
    colors = colors.with_extremes(bad=NOT_JUDGED)
    shown = _greatest_of_blocks(values, -(-max(rows, columns) // SHOWN_CELLS))
    axis.imshow(
        shown,
        cmap=colors,
        vmin=low,
        vmax=max(high, low + 1e-12),
        interpolation="nearest" if max(shown.shape) < 250 else "antialiased",
        extent=(-0.5, columns - 0.5, rows - 0.5, -0.5),
        interpolation_stage="rgba",
    )
    axis.spines[:].set_visible(True)
    axis.tick_params(length=2, labelsize=7)


def _greatest_of_blocks(values: np.ndarray, step: int) -> np.ndarray:
    if step <= 1:
        return values
    rows, columns = (-(-n // step) * step for n in values.shape)
    padded = np.full((rows, columns), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    return np.fmax.reduce(np.fmax.reduce(padded.reshape(rows // step, step, columns // step, step), axis=3), axis=1)


def draw_curve(
    axis: Axes, recall: np.ndarray, precision: np.ndarray, name: str, number: int, average_precision: float
) -> None:
    """Draw a curve as steps with the average precision as area, and a dot where precision falls below 1.

    recall, precision  (n,), recall ascending from 0
    number             index of the curve, which selects its color and line style
    """
    color = COLORS[number % len(COLORS)]
    line = LINES[number // len(COLORS) % len(LINES)]
    recall = recall[: len(precision)]  # a method without scores has no point
    label = textwrap.fill(f"{average_precision:.3f}  {name}", LABEL_WIDTH, subsequent_indent=" " * 11)
    axis.plot(recall, precision, line, color=color, linewidth=1.3, label=label, drawstyle="steps-pre")
    full = float(np.max(recall[precision >= 1.0], initial=0.0))
    if full > 0:
        axis.plot([full], [1.0], "o", color=color, markersize=4, clip_on=False)


def legends_below(figure: Figure, axes: Iterable[Axes]) -> None:
    """Put the legend of each panel below it, and increase the figure's height by that of the highest legend."""
    heights = []
    for axis in axes:
        below = axis.transAxes + ScaledTranslation(0, -LABELS_HEIGHT, figure.dpi_scale_trans)
        legend = axis.legend(
            title="average precision",
            fontsize=8,
            title_fontsize=8,
            loc="upper left",
            bbox_to_anchor=(0, 0),
            bbox_transform=below,
            borderaxespad=0,
            alignment="left",
        )
        for text in legend.get_texts():
            text.set_parse_math(False)
        heights.append(legend.get_window_extent().height / figure.dpi)
    figure.set_figheight(figure.get_figheight() + max(heights))


def longest_axes(positions: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return the two axes along which positions (N, 3) in meters, NaN where not known, are longest, and their names."""
    spans = np.nanmax(positions, axis=0) - np.nanmin(positions, axis=0)
    across = np.sort(np.argsort(-spans, kind="stable")[:2])
    return across, [f"{'xyz'[axis]} [m]" for axis in across]


def _draw_map(axis: Axes, outcome: Outcome, truth: Truth, positions: np.ndarray) -> None:
    across, names = longest_axes(positions)
    place = positions[:, across]
    axis.plot(place[:, 0], place[:, 1], color="#303030", linewidth=0.6, zorder=1)
    for order, (queries, references, color) in enumerate(_drawn(outcome, truth), start=2):
        chords = np.stack([place[queries], place[references]], axis=1)
        thin = min(1.0, 150 / max(len(chords), 1))  # so that a thousand lines do not merge
        width = 0.6 if color == MISSED else 0.9
        axis.add_collection(LineCollection(list(chords), colors=color, linewidths=width * thin, zorder=order))
        axis.plot(place[queries, 0], place[queries, 1], ".", color=color, markersize=2.5, zorder=order)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel(names[0])
    axis.set_ylabel(names[1])


def _drawn(outcome: Outcome, truth: Truth) -> list[tuple[np.ndarray, np.ndarray, str]]:
    """Return queries, references and a color for each group: missed, found, false."""
    found, false, missed = decisions(outcome, truth)
    reference = outcome.matches.reference
    return [
        (missed, best_true_references(outcome, truth, missed), MISSED),
        (found, reference[found], FOUND),
        (false, reference[false], FALSE),
    ]


def _draw_matches(axis: Axes, outcome: Outcome, truth: Truth) -> None:
    rows, columns = np.nonzero(truth.hard & truth.judged)
    axis.plot(columns, rows, ".", color="#d8d8d8", markersize=3, zorder=1)
    for order, (queries, references, color) in enumerate(_drawn(outcome, truth), start=2):
        axis.plot(references, queries, ".", color=color, markersize=4, zorder=order)
    axis.set_xlim(-1, truth.hard.shape[1])
    axis.set_ylim(truth.hard.shape[0], -1)
    axis.set_xlabel("reference")


def _loop_legend(figure: Figure) -> None:
    colors = [(FOUND, "found"), (FALSE, "false"), (MISSED, "missed")]
    lines = [Line2D([], [], color=color, linewidth=2, label=label) for color, label in colors]
    figure.legend(handles=lines, loc="outside upper center", ncols=len(colors))


def _state_truth(figure: Figure, evaluation: Evaluation, convention: str = "") -> None:
    """Print the description of the truth below the figure, so that the figure can be used alone."""
    text = f"{evaluation.data.name}. {convention + '; ' if convention else ''}{evaluation.data.truth.description}"
    text = printable(text)
    width = int(figure.get_figwidth() * 22)  # characters of this size that fit into the width
    figure.supxlabel(textwrap.fill(text, width), fontsize=6.5, color=figures.PALE, parse_math=False)


def _grid(panels: int, ratio: float) -> tuple[Figure, list[Axes]]:
    """Make a figure of panels in even rows of at most COLUMNS; ``ratio`` is a panel's height over its width."""
    rows = -(-panels // COLUMNS)
    columns = -(-panels // rows)
    width = 2.75 if columns > 2 else 3.4
    size = (width * columns, width * ratio * rows + 0.35)
    layout = ConstrainedLayoutEngine(h_pad=0.07)  # inches between a title and the panel above
    figure = Figure(figsize=size, layout=layout)
    flat = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis in flat[panels:]:
        axis.remove()
    return figure, flat[:panels]


def _name_panel(axis: Axes, outcome: Outcome) -> None:
    axis.set_title(textwrap.fill(outcome.name, TITLE_WIDTH), parse_math=False)


def _label_left(axes: list[Axes], label: str) -> None:
    """Label the vertical axis of the first panel of each row."""
    for axis in axes:
        place = axis.get_subplotspec()
        if place is not None and place.is_first_col():
            axis.set_ylabel(label)


def draw_paths(path: Path, closed: Closed, names: tuple[str, str] = ("odometry", "loops closed")) -> None:
    """Draw both paths, and the true path if it is known, as PNG, in the plane of the two longest axes.

    The paths are aligned with the true path. Lines between the two frames of a loop are green if the loop was used, and
    red if it contradicts the others.
    """
    paths = dict(zip(names, (closed.odometry, closed.poses), strict=True))
    if closed.truth is not None:
        known = np.all(np.isfinite(closed.truth), axis=1)
        if np.count_nonzero(known) >= 3:
            paths = {name: aligned(poses, closed.truth, known) for name, poses in paths.items()}
            paths["true"] = closed.truth[known]
    across, labels = longest_axes(list(paths.values())[-1][:, :3])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.6), layout="constrained")
        errors = closed.errors()
        for number, (axis, name) in enumerate(
            zip(figure.subplots(1, 2, sharex=True, sharey=True), paths, strict=False)
        ):
            poses = paths[name][:, across]
            if "true" in paths:
                axis.plot(*paths["true"][:, across].T, color=MISSED, lw=2.2, label="true path")
            ends = np.array([(edge.first, edge.second) for edge in closed.edges], int).reshape(-1, 2)
            colors = [FOUND if accepted else FALSE for accepted in closed.accepted]
            axis.add_collection(LineCollection(list(poses[ends]), colors=colors, linewidths=0.6, alpha=0.6))
            axis.plot(*poses.T, color=COLORS[1 - number], lw=1, label=name)
            error = "" if errors is None else f", ATE {next(iter(errors.values()))[number]:.3g} m"
            axis.set_title(f"{name}{error}")
            axis.set_xlabel(labels[0])
            axis.set_aspect("equal")
            axis.legend(loc="best")
            if number == 0:
                axis.set_ylabel(labels[1])
        write_whole(path, figures.png(figure))
