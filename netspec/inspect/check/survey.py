"""Examines a database: counts, labels, statistics of the values, and errors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from netspec.data.datum import shape_text
from netspec.files.limits import amount
from netspec.inspect.records import Record, Records

Progress = Callable[[Iterable[int]], Iterable[int]]  # like tqdm: wraps an iterable
_MOST_FAULTS = 100  # errors to keep with their keys; all are counted
MOST_LABELS = 8  # labels to list one by one


@dataclass
class Channels:
    """Statistics over all values of each channel, for records with the same number of channels."""

    count: int = 0
    sums: np.ndarray = field(default_factory=lambda: np.zeros(0))
    squares: np.ndarray = field(default_factory=lambda: np.zeros(0))
    least: np.ndarray = field(default_factory=lambda: np.zeros(0))
    most: np.ndarray = field(default_factory=lambda: np.zeros(0))
    histogram: np.ndarray | None = None

    def add(self, values: np.ndarray) -> None:
        """Add the values (C, H, W) of a record; for bytes, count how often each of the 256 values occurs."""
        flat = values.reshape(len(values), -1)
        if not len(self.sums):
            size = len(values)
            self.sums, self.squares = np.zeros(size), np.zeros(size)
            self.least, self.most = np.full(size, np.inf), np.full(size, -np.inf)
            self.histogram = np.zeros((size, 256), np.int64) if values.dtype == np.uint8 else None
        self.count += flat.shape[1]
        if values.dtype == np.uint8 and self.histogram is not None:
            self.histogram += np.stack([np.bincount(channel, minlength=256) for channel in flat])
        else:
            self.histogram = None
        wide = flat.astype(np.float64)
        self.sums += wide.sum(axis=1)
        self.squares += np.square(wide).sum(axis=1)
        self.least, self.most = np.minimum(self.least, flat.min(axis=1)), np.maximum(self.most, flat.max(axis=1))

    @property
    def mean(self) -> np.ndarray:
        """The mean of each channel (C,)."""
        return self.sums / max(self.count, 1)

    @property
    def deviation(self) -> np.ndarray:
        """The standard deviation of each channel (C,)."""
        return np.sqrt(np.maximum(self.squares / max(self.count, 1) - np.square(self.mean), 0))


@dataclass(frozen=True)
class Fault:
    """A wrong record: its index, its key, and a line that describes the error."""

    number: int
    key: str
    text: str


@dataclass
class Survey:
    """The result of :func:`survey`.

    ``records`` of ``total`` records were read. ``forms`` counts records by storage and shape, ``labels`` by label.
    ``faults`` are records that a data layer would refuse.
    """

    total: int
    records: int = 0
    size: int = 0
    forms: Counter[str] = field(default_factory=Counter)
    labels: Counter[float] = field(default_factory=Counter)
    unlabeled: int = 0
    channels: Channels = field(default_factory=Channels)
    faults: list[Fault] = field(default_factory=list)
    num_faults: int = 0


def survey(records: Records, numbers: Sequence[int], progress: Progress = iter) -> Survey:
    """Examine the records with these numbers."""
    found = Survey(len(records))
    first = None
    for number in progress(numbers):
        record = records[number]
        found.records += 1
        found.size += record.size
        if record.label is None:
            found.unlabeled += 1
        else:
            found.labels[record.label] += 1
        if record.values is not None:
            first = first or record
            found.forms[f"{record.kind}, {shape_text(record.values.shape)}"] += 1
        else:
            found.forms[record.kind] += 1
        fault = record.fault if record.values is None or first is None else _fault(record, first)
        if fault:
            found.num_faults += 1
            if len(found.faults) < _MOST_FAULTS:
                found.faults.append(Fault(number, record.key, fault))
        elif record.values is not None:
            found.channels.add(record.values)
    return found


def _fault(record: Record, first: Record) -> str:
    """Return the error in a readable record; "" if there is none."""
    assert record.values is not None
    assert first.values is not None
    if record.values.shape != first.values.shape:
        expected = f'the first record, "{first.key}", {shape_text(first.values.shape)}'
        return f"is {shape_text(record.values.shape)}, {expected}"
    if record.values.dtype != np.uint8 and not np.isfinite(record.values).all():
        return "contains a NaN or an infinity"
    return ""


def as_lines(found: Survey, name: str) -> list[str]:
    """Return the survey as lines of text."""
    looked = "" if found.records == found.total else f", {found.records:,} of them read"
    lines = [f"{name}: {found.total:,} records{looked}, {amount(found.size)} of values"]
    lines += [f"  {count:>9,}  {form}" for form, count in found.forms.most_common(10)]
    lines += [f"labels: {labels_line(found)}"]
    channels = found.channels
    for k, mean in enumerate(channels.mean[:12]):
        spread = f"deviation {channels.deviation[k]:.4g}, {channels.least[k]:g} to {channels.most[k]:g}"
        lines.append(f"channel {k}: mean {mean:.4g}, {spread}")
    if len(channels.mean) > 12:
        lines.append(f"and {len(channels.mean) - 12} more channels")
    return lines


def labels_line(found: Survey) -> str:
    """Return how often the labels occur, in one line."""
    common = sorted(found.labels.items()) if len(found.labels) <= MOST_LABELS else found.labels.most_common(MOST_LABELS)
    listed = ", ".join(f"{label:g} ({count:,})" for label, count in common)
    if len(found.labels) > MOST_LABELS:
        counts = found.labels.values()
        listed = (
            f"{len(found.labels):,} different ones, {min(counts):,} to {max(counts):,} records each; most: {listed}"
        )
    missing = f"{found.unlabeled:,} without" if found.unlabeled else ""
    return ", ".join(part for part in (listed, missing) if part) or "none"
