"""Reads many small Datums of the same form together, as one array.

A small net takes less time for a record than parsing the record takes. The records of a database often differ only in
the bytes of their numbers and labels. So one record is parsed, and its layout is used for all records that have the
same other bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from netspec.data.blobs import Shape
from netspec.data.datum import datum_to_array, parse_datum
from netspec.proto.schema import Datum
from netspec.proto.wire import BYTES, FOUR, fields

MOST_BYTES = 1 << 16  # of a record; for a larger one, copying takes longer than parsing
_MOST_FORMS = 64  # that are remembered
_DATA, _LABEL, _FLOATS = (Datum.DESCRIPTOR.fields_by_name[name].number for name in ("data", "label", "float_data"))


class _Form(NamedTuple):
    """A parsed record, and the positions of its numbers and its label.

    Records of the same form have the same size and the same bytes at all other positions.
    """

    record: np.ndarray
    shape: Shape
    values: slice
    label: slice
    step: int  # bytes between numbers: 1 for uint8, 4 for floats, 5 for floats with tags


class Stacker:
    """Reads records as arrays, and remembers their forms.

    ``decode`` returns the numbers of a raw Datum as an array (C, H, W).
    """

    def __init__(self, decode: Callable[[Any], np.ndarray] = datum_to_array) -> None:
        self._decode = decode
        self._forms: dict[int, _Form] = {}

    def __call__(self, records: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray] | None:
        """Return images (N, C, H, W), uint8 or float32, and labels (N,), float32.

        Returns None if the records have different forms, or are encoded, large or wrong. The caller then reads them one
        by one.
        """
        sizes = [len(record) for record in records]
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
        form = self._forms.get(size) or _form_of(records[0], self._decode)
        if form is None:
            return None
        rows = np.frombuffer(b"".join(records), np.uint8).reshape(len(records), size)
        found = _unpacked(rows, form)
        if found is None and (rows[0] != form.record).any():  # the remembered form is that of other records
            form = _form_of(records[0], self._decode)
            found = None if form is None else _unpacked(rows, form)
        if form is not None:
            if len(self._forms) >= _MOST_FORMS:
                self._forms.clear()
            self._forms[size] = form
        return found


def _unpacked(rows: np.ndarray, form: _Form) -> tuple[np.ndarray, np.ndarray] | None:
    """Return images and labels of rows of bytes; None if one of them has a different form."""
    (first, second), start = sorted((form.values, form.label), key=lambda part: part.start), 0
    for part in (first, second, slice(rows.shape[1], rows.shape[1])):
        if (rows[:, start : part.start] != form.record[start : part.start]).any():
            return None
        start = part.stop
    labels, values = rows[:, form.label], rows[:, form.values]
    count = labels.shape[1]  # of bytes; all but the last have the highest bit set (a varint)
    if count and ((labels[:, :-1] < 128).any() or (labels[:, -1] >= 128).any()):
        return None
    if form.step == 5:
        tagged = values.reshape(len(rows), -1, 5)
        if (tagged[:, :, 0] != _FLOATS << 3 | FOUR).any():
            return None
        values = tagged[:, :, 1:]
    if form.step > 1:
        values = np.ascontiguousarray(values).view("<f4")
    shifts = np.arange(0, 7 * count, 7, dtype=np.uint64)
    label = ((labels & 127).astype(np.uint64) << shifts).sum(axis=1, dtype=np.uint64)
    values = values[:, : math.prod(form.shape)]
    return values.reshape(len(rows), *form.shape), label.astype(np.uint32).view(np.int32).astype(np.float32)


def _form_of(record: bytes, decode: Callable[[Any], np.ndarray]) -> _Form | None:
    """Return the form of a record; None if it is encoded, inconsistent, or has a field several times."""
    try:
        found = list(fields(record, 0, len(record)))
        datum = parse_datum(record)
        if datum.encoded:
            return None
        shape = decode(datum).shape
    except ValueError:
        return None
    floats = [field for field in found if field.number == _FLOATS]
    others = [field.number for field in found if field.number != _FLOATS]
    if len(set(others)) < len(others):
        return None
    places = {field.number: slice(field.start, field.end) for field in found}
    label = places.get(_LABEL, slice(0, 0))
    if datum.data:
        values, step = places[_DATA], 1
        if floats:
            return None
    else:
        packed = floats[0].kind == BYTES
        step, values = (4, places[_FLOATS]) if packed else (5, slice(floats[0].tag, floats[-1].end))
        if values.stop - values.start != step * len(datum.float_data):
            return None
    return _Form(np.frombuffer(record, np.uint8), shape, values, label, step)
