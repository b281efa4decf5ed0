"""Examines a database: counts, labels, statistics of the values, and errors."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from netspec.data.datum import shape_text
from netspec.files.limits import amount
from netspec.inspect.records import Record, Records

Progress = Callable[[Iterable[int]], Iterable[int]]  # like tqdm: wraps an iterable
_MOST_FAULTS = 100  # errors to keep with their keys; all are counted
MOST_LABELS = 8  # labels to list one by one
_SORTED = 100  # with this many records, sorted labels are no coincidence


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
    ``faults`` are records that a data layer would refuse. ``notes`` mention anything else that is unusual.
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
    notes: list[str] = field(default_factory=list)


def survey(records: Records, numbers: Sequence[int], progress: Progress = iter) -> Survey:
    """Examine the records with these numbers."""
    found = Survey(len(records))
    watch = _Watch(found)
    for number in progress(numbers):
        record = records[number]
        found.records += 1
        found.size += record.size
        if record.label is None:
            found.unlabeled += 1
        else:
            found.labels[record.label] += 1
        fault = record.fault or watch.fault(record)
        if fault:
            found.num_faults += 1
            if len(found.faults) < _MOST_FAULTS:
                found.faults.append(Fault(number, record.key, fault))
        watch.see(record, sound=not fault)
    found.notes = list(watch.notes())
    return found


class _Watch:
    """The state for comparing later records with earlier ones."""

    def __init__(self, found: Survey) -> None:
        self._found = found
        self._first: Record | None = None
        self._hashes: list[int] = []
        self._labels: list[float] = []
        self._flat = 0

    def fault(self, record: Record) -> str:
        """Return the error in a readable record; "" if there is none."""
        values = record.values
        assert values is not None
        if self._first is None:
            self._first = record
        assert self._first.values is not None
        if values.shape != self._first.values.shape:
            first = f'the first record, "{self._first.key}", {shape_text(self._first.values.shape)}'
            return f"is {shape_text(values.shape)}, {first}"
        if values.dtype != np.uint8 and not np.isfinite(values).all():
            return "contains a NaN or an infinity"
        return ""

    def see(self, record: Record, sound: bool) -> None:
        """Count a record. If it is ``sound``, also add its values to the statistics."""
        values = record.values
        if values is None:
            self._found.forms[record.kind] += 1
            return
        self._found.forms[f"{record.kind}, {shape_text(values.shape)}"] += 1
        self._flat += bool(values.size > 1 and (values == values.flat[0]).all())
        if sound:
            self._found.channels.add(values)
        digest = hashlib.blake2b(values.tobytes(), digest_size=8).digest()
        self._hashes.append(int.from_bytes(digest, "little"))
        self._labels.append(np.nan if record.label is None else record.label)

    def notes(self) -> Iterable[str]:
        """Yield notes about anything unusual."""
        labels = np.array(self._labels)
        _, place, counts = np.unique(np.array(self._hashes, np.uint64), return_inverse=True, return_counts=True)
        if (twice := int((counts - 1).sum())) > 0:
            yield f"records with the same values as another record: {twice:,}"
        least, most = (np.full(len(counts), end) for end in (np.inf, -np.inf))
        known = ~np.isnan(labels)
        np.minimum.at(least, place[known], labels[known])
        np.maximum.at(most, place[known], labels[known])
        if differing := int((most > least).sum()):
            yield f"images that occur with different labels: {differing:,}"
        if self._flat:
            yield f"records in which all values are equal: {self._flat:,}"
        if 0 < self._found.unlabeled < self._found.records:
            yield f"records without a label, which Caffe reads as 0: {self._found.unlabeled:,}"
        if len(labels) >= _SORTED and len(self._found.labels) > 1 and (np.diff(labels) >= 0).all():
            yield "the records are sorted by label, so batches have few classes; shuffle when converting"


def as_json(found: Survey) -> dict[str, Any]:
    """Return the survey as a dictionary for JSON."""
    channels = found.channels
    return {
        "records": found.total,
        "looked_at": found.records,
        "bytes": found.size,
        "forms": dict(found.forms),
        "labels": {f"{label:g}": count for label, count in sorted(found.labels.items())},
        "unlabeled": found.unlabeled,
        "channels": [
            {"mean": float(mean), "deviation": float(deviation), "least": float(least), "most": float(most)}
            for mean, deviation, least, most in zip(
                channels.mean, channels.deviation, channels.least, channels.most, strict=True
            )
        ],
        "num_faults": found.num_faults,
        "faults": [{"key": fault.key, "fault": fault.text} for fault in found.faults],
        "notes": found.notes,
    }


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
    return lines + [f"note: {note}" for note in found.notes]


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
