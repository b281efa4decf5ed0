"""Draws a sheet of records: images with keys and labels, statistics of the database, and its errors."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from netspec.files.figures import COLORS, PALE
from netspec.inspect.check.survey import Survey, as_lines
from netspec.inspect.draw.style import (
    FAULT,
    STYLE,
    as_picture,
    draw_tile,
    images_in,
    split,
    text_at,
    what_is_shown,
)
from netspec.inspect.records import Record

WIDTH, HEAD = 12.0, 2.1  # inches
LONGER, CAPTION, GAP = 1.4, 0.44, 0.14  # inches: a tile's longer side, the two lines below it, between tiles
SEAM = 0.04  # inches between the images of one record
LINE = 0.155  # inches
CHANNEL_COLORS = {1: ("#555555",), 2: ("#0072B2", "#D55E00"), 3: ("#2b5fd9", "#2e8b3d", "#c62828")}  # blue, green, red


def sheet(records: Sequence[Record], found: Survey, name: str, images: int | None = None) -> Figure:
    """Draw records as tiles below the statistics that :func:`netspec.inspect.check.survey.survey` found.

    ``images`` is the number of images in a record, drawn side by side; the default is two for 2 or 6 channels.
    """
    usual = _usual(records)
    side_by_side = images or (1 if usual is None else images_in(usual))
    size = _tile_size(usual)
    width, tall = side_by_side * (size[0] + SEAM) - SEAM, size[1]
    columns = max(1, int((WIDTH + GAP) / (width + GAP)))
    rows = -(-len(records) // columns)
    lines = [*((line, "black") for line in as_lines(found, name)), *_fault_lines(found)]
    note = "" if usual is None else what_is_shown(split(usual, side_by_side)[0])
    lines += [(f"shown: {note}", "black")] if note else []
    wrapped = [(part, color) for line, color in lines for part in textwrap.wrap(line, 88, subsequent_indent="    ")]
    head = max(HEAD, LINE * (len(wrapped) + 2))
    height = head + rows * (tall + CAPTION + GAP) + GAP
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH + 2 * GAP, height))
        whole = figure.add_axes((0, 0, 1, 1))
        whole.set_axis_off()
        _draw_head(figure, whole, wrapped, found, height, head)
        for number, record in enumerate(records):
            row, column = divmod(number, columns)
            left = GAP + column * (width + GAP)
            bottom = height - head - (row + 1) * (tall + CAPTION + GAP) + CAPTION
            _draw_record(whole, record, left, bottom, side_by_side, size)
        whole.set_xlim(0, WIDTH + 2 * GAP)
        whole.set_ylim(0, height)
        return figure


def _usual(records: Sequence[Record]) -> np.ndarray | None:
    """Return the values of a record with the most frequent shape; None if no record can be read."""
    by_shape = {record.values.shape: record.values for record in records if record.values is not None}
    counts = Counter(record.values.shape for record in records if record.values is not None)
    return by_shape[counts.most_common(1)[0][0]] if counts else None


def _tile_size(usual: np.ndarray | None) -> tuple[float, float]:
    """Return the width and the height of a tile [inches] for images in the form of the usual one."""
    if usual is None or usual.shape[1:] == (1, 1):
        return LONGER, LONGER
    height, width = usual.shape[1:]
    scale = LONGER / max(height, width)
    return max(width * scale, LONGER / 4), max(height * scale, LONGER / 4)


def _fault_lines(found: Survey) -> list[tuple[str, str]]:
    """Return the lines about the errors, with their colors."""
    if not found.num_faults:
        return [("errors: none", "black")]
    count = "1 record" if found.num_faults == 1 else f"{found.num_faults:,} records"
    examples = [(f"  {fault.key}: {fault.text}", "black") for fault in found.faults[:3]]
    return [(f"errors: {count} that a data layer refuses", FAULT), *examples]


def _draw_head(
    figure: Figure, whole: Axes, lines: Sequence[tuple[str, str]], found: Survey, height: float, head: float
) -> None:
    for number, (line, color) in enumerate(lines):
        weight = "bold" if number == 0 else "normal"
        y = height - GAP - LINE * (number + 1)
        text_at(whole, GAP, y, line, fontsize=8.5, color=color, fontweight=weight)
    bottom = (height - min(head, HEAD) + 0.5) / height
    tall = (min(head, HEAD) - 0.9) / height
    if 1 < len(found.labels) <= 1000:
        _draw_labels(figure.add_axes((0.585, bottom, 0.17, tall)), found)
    if found.channels.histogram is not None:
        _draw_values(figure.add_axes((0.81, bottom, 0.17, tall)), found.channels.histogram)


def _draw_labels(axis: Axes, found: Survey) -> None:
    labels = sorted(found.labels)
    counts = [found.labels[label] for label in labels]
    if len(labels) <= 12:
        axis.bar(range(len(labels)), counts, color=COLORS[0])
        axis.set_xticks(range(len(labels)), [f"{label:g}" for label in labels])
    else:
        axis.bar(labels, counts, color=COLORS[0], width=0.8 if len(labels) < 50 else 1.0)
    axis.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    _finish(axis, "records per label")


def _draw_values(axis: Axes, histogram: np.ndarray) -> None:
    pairs = len(histogram) in (2, 6)
    shown = histogram.reshape(2, -1, 256).sum(axis=0) if pairs else histogram
    colors = CHANNEL_COLORS.get(len(shown), ("#555555",))
    for channel, counts in enumerate(shown[: len(colors)]):
        axis.plot(counts / max(counts.sum(), 1), color=colors[channel], linewidth=0.9)
    axis.set_xlim(0, 255)
    axis.set_xticks([0, 128, 255])
    axis.set_yticks([])
    _finish(axis, "values" if len(shown) == 1 else "values, by channel")


def _finish(axis: Axes, title: str) -> None:
    axis.set_title(title, fontsize=8.5)
    axis.tick_params(labelsize=7.5, length=2)


def _draw_record(
    axis: Axes, record: Record, left: float, bottom: float, images: int, size: tuple[float, float]
) -> None:
    width, height = images * (size[0] + SEAM) - SEAM, size[1]
    label = "no label" if record.label is None else f"label {record.label:g}"
    if record.values is None:
        axis.add_patch(Rectangle((left, bottom), width, height, facecolor="#fdecea", edgecolor=FAULT, linewidth=1.2))
        text = textwrap.fill(record.fault, int(width * 12))
        text_at(axis, left + 0.06, bottom + height - 0.08, text, fontsize=7.5, color=FAULT, va="top")
    else:
        for k, part in enumerate(split(record.values, images)):
            draw_tile(axis, as_picture(part), left + k * (size[0] + SEAM), bottom, *size)
    longest = int(width * 14)
    key = record.key if len(record.key) <= longest else ".." + record.key[-longest + 2 :]
    text_at(axis, left, bottom - 0.17, label, fontsize=8.5, fontweight="bold")
    text_at(axis, left, bottom - 0.33, key, fontsize=7.5, color=PALE)
