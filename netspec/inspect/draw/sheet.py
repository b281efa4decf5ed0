"""Draws records of a database: their images, keys and labels."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from netspec.data.database import Reader
from netspec.data.datum import datum_to_array, parse_datum
from netspec.data.random_words import words
from netspec.errors import SpecError, printable
from netspec.inspect.draw.style import FAULT, STYLE

WIDTH, TALL, LINES, GAP = 12.0, 1.4, 0.36, 0.14  # inches: the sheet, a tile, the two lines above it, between tiles
NARROWEST, WIDEST = 0.7, 4.0  # inches: a tile
LONGEST = 22  # characters of a key, of which the end is drawn


class Record(NamedTuple):
    """A record: its key, values (C, H, W), and label, or, if it cannot be read, the reason."""

    key: str
    values: np.ndarray | None
    label: int | None
    fault: str = ""


def read_record(reader: Reader, number: int) -> Record:
    """Return a record of a database, which may be damaged."""
    key, label = reader.key(number).decode(errors="backslashreplace"), None
    try:
        datum: Any = parse_datum(reader.record(number))
        label = datum.label if datum.HasField("label") else None
        return Record(key, datum_to_array(datum), label)
    except (SpecError, ValueError) as fault:
        return Record(key, None, label, getattr(fault, "message", str(fault)))


def spread(count: int, wanted: int) -> list[int]:
    """Return ``wanted`` of the numbers below ``count``, one from each of ``wanted`` equal parts; or all.

    Each is drawn at random from its part, with a fixed seed, since labels often alternate.
    """
    if wanted >= count:
        return list(range(count))
    ends = [k * count // wanted for k in range(wanted + 1)]
    draws = words(0, "spread", 0, wanted)[:, 0].tolist()
    return [low + draw % (high - low) for low, high, draw in zip(ends, ends[1:], draws, strict=False)]


def picture(values: np.ndarray) -> np.ndarray:
    """Return values (C, H, W) as brightness (H, W) or (H, W, 3), 0 to 1; those of 2 or 6 channels as two images.

    Bytes are not scaled; other values are scaled from the minimum (black) to the maximum (white). Three channels are
    blue, green, red, as in OpenCV; of other numbers, the mean is drawn. A vector becomes a block.
    """
    if values.shape[1:] == (1, 1):
        vector = values.reshape(-1)
        side = int(np.ceil(np.sqrt(len(vector))))
        values = np.pad(vector, (0, side * side - len(vector)), mode="minimum").reshape(1, side, side)
    shown = values.astype(np.float64)
    if values.dtype != np.uint8:
        low, high = (float(end(shown[np.isfinite(shown)], initial=0)) for end in (np.min, np.max))
        shown = np.nan_to_num((shown - low) / ((high - low) or 1), posinf=0, neginf=0) * 255
    images = np.split(shown / 255, 2) if len(shown) in (2, 6) else [shown / 255]
    drawn = [image[2::-1].transpose(1, 2, 0) if len(image) in (3, 4) else image.mean(axis=0) for image in images]
    seam = np.ones_like(drawn[0][:, : max(1, drawn[0].shape[1] // 24)])
    return np.hstack([drawn[0], *(part for image in drawn[1:] for part in (seam, image))])


def sheet(records: Sequence[Record], title: str) -> Figure:
    """Draw records as tiles below a title."""
    pictures = [None if record.values is None else picture(record.values) for record in records]
    shape = next((each.shape for each in pictures if each is not None), (1, 1))
    wide = min(max(TALL * shape[1] / shape[0], NARROWEST), WIDEST)
    columns = max(1, int(WIDTH / (wide + GAP)))
    rows = -(-len(records) // columns)
    height = rows * (TALL + LINES + GAP) + 2 * LINES
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(columns * (wide + GAP), height))
        figure.text(0.01, 1 - LINES / 2 / height, printable(title), va="center", weight="bold", parse_math=False)
        axes = figure.subplots(rows, columns, squeeze=False)
        figure.subplots_adjust(0.01, 0.02, 0.99, 1 - 2 * LINES / height, GAP / wide, (LINES + GAP) / TALL)
        for axis in axes.flat:
            axis.set_axis_off()
        for axis, record, drawn in zip(axes.flat, records, pictures, strict=False):
            label = "no label" if record.label is None else f"label {record.label}"
            axis.set_title(f"{label}\n{printable(record.key)[-LONGEST:]}", fontsize=7.5, parse_math=False)
            if drawn is None:
                text = textwrap.fill(printable(record.fault), int(wide * 12))
                axis.text(0.5, 0.5, text, fontsize=7.5, color=FAULT, ha="center", va="center", parse_math=False)
            else:
                axis.imshow(drawn, cmap="gray", vmin=0, vmax=1)
        return figure
