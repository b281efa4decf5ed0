"""Datums of one form, read together: the numbers of many small records as one array.

To parse each record by itself takes longer than a small net needs for it. Records of a database are alike byte for byte
but for their numbers and labels, so what was parsed of one holds for all that have its bytes elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from netspec.data.blobs import Shape
from netspec.data.datum import parse_datum
from netspec.proto.schema import Datum

MOST_BYTES = 1 << 16  # of a record: to copy a larger one together with others takes longer than to parse it
_MOST_FORMS = 64
_DATA, _LABEL, _FLOATS = (Datum.DESCRIPTOR.fields_by_name[name].number for name in ("data", "label", "float_data"))
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # wire types


class _Form(NamedTuple):
    """Where numbers and label lie in records of one size, and the bytes of the first one, equal in all elsewhere."""

    record: np.ndarray
    shape: Shape
    values: slice
    label: slice
    step: int  # bytes from number to number: 1 for uint8, 4 for floats, 5 for floats each with its tag


class Stacker:
    """Reads records as arrays; it remembers the forms that it has seen."""

    def __init__(self) -> None:
        self._forms: dict[int, _Form] = {}

    def __call__(self, records: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray] | None:
        """Return images (N, C, H, W), uint8 or float32, and labels (N,), float32.

        None if the records are not alike, encoded, large, or wrong: they must then be read one by one.
        """
        sizes = list(map(len, records))
        if max(sizes) > MOST_BYTES:
            return None
        if min(sizes) == max(sizes):
            return self._read(records)
        images, labels = None, np.empty(len(records), np.float32)
        for size in set(sizes):
            here = [k for k, each in enumerate(sizes) if each == size]
            found = self._read([records[k] for k in here])
            if found is None:
                return None
            if images is None:
                images = np.empty((len(records), *found[0].shape[1:]), found[0].dtype)
            if (images.shape[1:], images.dtype) != (found[0].shape[1:], found[0].dtype):
                return None
            images[here], labels[here] = found
        return None if images is None else (images, labels)

    def _read(self, records: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray] | None:
        """Return images and labels of records of one size."""
        size = len(records[0])
        form = self._forms.get(size) or _form_of(records[0])
        if form is None:
            return None
        rows = np.frombuffer(b"".join(records), np.uint8).reshape(len(records), size)
        found = _unpacked(rows, form)
        if found is None and (rows[0] != form.record).any():  # a form of another database, or of its first records
            form = _form_of(records[0])
            found = None if form is None else _unpacked(rows, form)
        if form is not None:
            if len(self._forms) >= _MOST_FORMS:
                self._forms.clear()
            self._forms[size] = form
        return found


def _unpacked(rows: np.ndarray, form: _Form) -> tuple[np.ndarray, np.ndarray] | None:
    """Return images and labels of rows of bytes; None if one of them has another form."""
    (first, second), start = sorted((form.values, form.label), key=lambda part: part.start), 0
    for part in (first, second, slice(rows.shape[1], rows.shape[1])):
        if (rows[:, start : part.start] != form.record[start : part.start]).any():
            return None
        start = part.stop
    labels, values = rows[:, form.label], rows[:, form.values]
    count = labels.shape[1]
    if count and ((labels[:, :-1] < 128).any() or (labels[:, -1] >= 128).any()):
        return None
    if form.step == 5:
        tagged = values.reshape(len(rows), -1, 5)
        if (tagged[:, :, 0] != _FLOATS << 3 | _FOUR).any():
            return None
        values = tagged[:, :, 1:]
    if form.step > 1:
        values = np.ascontiguousarray(values).view("<f4")
    shifts = np.arange(0, 7 * count, 7, dtype=np.uint64)
    label = ((labels & 127).astype(np.uint64) << shifts).sum(axis=1, dtype=np.uint64)
    return values.reshape(len(rows), *form.shape), label.astype(np.uint32).view(np.int32).astype(np.float32)


def _form_of(record: bytes) -> _Form | None:
    """Return the form of a record; None if it is encoded, contradicts itself, or has a field several times."""
    try:
        fields = list(_fields(record))
        datum = parse_datum(record)
    except (ValueError, IndexError):
        return None
    floats = [field for field in fields if field[0] == _FLOATS]
    others = [field[0] for field in fields if field[0] != _FLOATS]
    shape = (datum.channels, datum.height, datum.width)
    count = shape[0] * shape[1] * shape[2]
    if datum.encoded or len(set(others)) < len(others) or min(shape) <= 0:
        return None
    places = {number: slice(start, end) for number, _, _, start, end in fields}
    label = places.get(_LABEL, slice(0, 0))
    if datum.data:
        values, step, found = places[_DATA], 1, len(datum.data)
        if floats:
            return None
    else:
        found = len(datum.float_data)
        if found != count:
            return None
        step = 4 if len(floats) == 1 and floats[0][1] == _BYTES else 5
        values = slice(floats[0][3 if step == 4 else 2], floats[-1][4])
        if step == 5 and values.stop - values.start != 5 * count:
            return None
    if found != count:
        return None
    return _Form(np.frombuffer(record, np.uint8), shape, values, label, step)


def _fields(record: bytes) -> Iterator[tuple[int, int, int, int, int]]:
    """Yield number, wire type and place of each field: where its tag starts, and where its contents start and end."""
    place = 0
    while place < len(record):
        first = place
        tag, place = _varint(record, place)
        kind, start = tag & 7, place
        if kind == _VARINT:
            _, place = _varint(record, place)
        elif kind == _BYTES:
            size, start = _varint(record, place)
            place = start + size
        elif kind in (_EIGHT, _FOUR):
            place += 8 if kind == _EIGHT else 4
        else:
            raise ValueError(f"has a field of wire type {kind}")
        yield tag >> 3, kind, first, start, place


def _varint(record: bytes, place: int) -> tuple[int, int]:
    """Return a number of one or more bytes, and where it ends."""
    found = shift = 0
    while record[place] >= 128:
        found |= (record[place] & 127) << shift
        place, shift = place + 1, shift + 7
    return found | record[place] << shift, place + 1
