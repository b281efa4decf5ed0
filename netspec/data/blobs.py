"""BlobProto <-> ndarray: Caffe's arrays on disk, in weights, solver states and mean files.

Caffe: src/caffe/blob.cpp (FromProto, ToProto, ShapeEquals)
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from netspec.proto.schema import BlobProto, BlobShape
from netspec.proto.wire import PLACE, fields

Shape = tuple[int, ...]
LEGACY_AXES = ("num", "channels", "height", "width")
_AT_ONCE = 1 << 20  # numbers that are read at once: the next copy finds them in the processor's cache
_DATA, _DIFF = ("data", "double_data"), ("diff", "double_diff")

# NVIDIA Caffe's BlobProto, which DIGITS 6 and OpenCV's half-precision tools write too: `raw_data_type`, an enum, and
# `raw_data`, little-endian bytes beside the shape and instead of `data`.
_RAW_TYPE, _RAW_DATA = ("raw_data_type", 10), ("raw_data", 12)
_RAW_DTYPES = ("<f8", "<f4", "<f2", "<i4", "<u4")  # DOUBLE, FLOAT, FLOAT16, INT, UINT


def shape_of(proto: Any) -> Shape:
    """Return the shape: ``shape``, or the four old fields num, channels, height, width if any of them is given."""
    if is_legacy(proto):
        return tuple(getattr(proto, axis) for axis in LEGACY_AXES)
    return tuple(proto.shape.dim)


def is_legacy(proto: Any) -> bool:
    """Return whether the shape is given by the four old fields."""
    return any(proto.HasField(axis) for axis in LEGACY_AXES)


def fits(proto: Any, shape: Sequence[int]) -> bool:
    """Return whether the blob may be copied into an array of ``shape`` (Caffe: Blob::ShapeEquals).

    An old 4-D shape fits a shape of fewer axes if they are equal with ones put in front: (1, 1, 1, 500) fits (500,).
    """
    if is_legacy(proto):
        return len(shape) <= 4 and shape_of(proto) == (1,) * (4 - len(shape)) + tuple(shape)
    return shape_of(proto) == tuple(shape)


def to_array(proto: Any) -> np.ndarray:
    """Return the values in the blob's shape: float32, or float64 if the blob holds doubles. The array is read-only.

    Where the blob has neither data nor double_data, the numbers in its raw_data are returned: half precision and
    integers as float32. Raises ValueError where there are not as many values as the shape says.
    """
    return _values(proto, _DATA)


def diff_to_array(proto: Any) -> np.ndarray | None:
    """Return the gradient in the blob's shape, or None if the blob has no gradient; see :func:`to_array`."""
    return _values(proto, _DIFF) if any(len(getattr(proto, name)) for name in _DIFF) else None


def from_array(values: np.ndarray, diff: np.ndarray | None = None) -> Any:
    """Return a BlobProto of the values, and of their gradient: float32 as Caffe writes, or doubles from float64."""
    wide = values.dtype == np.float64
    runs = _Runs()
    for array, names in ((values, _DATA), (diff, _DIFF)):
        if array is not None:
            setattr(runs, names[wide], np.ascontiguousarray(array, "<f8" if wide else "<f4").tobytes())
    proto = _of_shape(values.shape)
    proto.MergeFromString(runs.SerializeToString())
    return proto


def in_half_precision(values: np.ndarray) -> Any:
    """Return a BlobProto of the values, rounded to half precision, as NVIDIA Caffe and OpenCV write them: raw_data."""
    runs = _Runs(raw_data_type=_RAW_DTYPES.index("<f2"), raw_data=values.astype("<f2").tobytes())
    proto = _of_shape(values.shape)
    proto.MergeFromString(runs.SerializeToString())
    return proto


def _of_shape(shape: Shape) -> Any:
    """Return a BlobProto of a shape; like Caffe's, one of no axes has no field ``shape``."""
    return BlobProto(shape=BlobShape(dim=shape)) if shape else BlobProto()


def _values(proto: Any, names: tuple[str, str]) -> np.ndarray:
    single, double = names
    name, dtype = (double, "<f8") if len(getattr(proto, double)) else (single, "<f4")
    found, shape = len(getattr(proto, name)), shape_of(proto)
    count, stored = math.prod(shape), proto.SerializeToString()
    if not found and count and names == _DATA and (runs := _Runs.FromString(stored)).raw_data:
        return _raw_values(runs, count).reshape(shape)
    _check_count(found, name, shape)
    number = BlobProto.DESCRIPTOR.fields_by_name[name].number
    start = next((field.start for field in fields(stored, 0, len(stored)) if field.number == number), 0)
    return np.frombuffer(stored, dtype, count, start).reshape(shape)


def _check_count(found: int, name: str, shape: Shape) -> None:
    if found != math.prod(shape):
        raise ValueError(f"found {found} numbers in {name}, expected {math.prod(shape)} for shape {shape}")


class Elsewhere(NamedTuple):
    """Numbers that were left in the file, little-endian float32: where, and their shape."""

    file: BinaryIO
    start: int
    shape: Shape

    def parts(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield all numbers in order, part by part, each with the count of those before it.

        A part is good until the next. Raises OSError where they cannot be read, ValueError where the file was cut.
        """
        count = math.prod(self.shape)
        part = np.empty(min(_AT_ONCE, count), "<f4")
        self.file.seek(self.start)
        for done in range(0, count, len(part)):
            here = part[: count - done]
            if self.file.readinto(memoryview(here).cast("B")) < here.nbytes:  # type: ignore[attr-defined]
                raise ValueError("was cut by another program while it was read")
            yield done, here


def elsewhere(proto: Any, file: BinaryIO | None) -> Elsewhere | None:
    """Return where a blob's numbers lie that were left in the file; None if it has them itself.

    Raises ValueError as :func:`to_array`.
    """
    place = _Runs.FromString(proto.SerializeToString()).place if file and not proto.data else ()
    if not file or not place:
        return None
    start, size = place
    _check_count(size // 4, "data", shape_of(proto))
    return Elsewhere(file, start, shape_of(proto))


def _raw_values(runs: Any, count: int) -> np.ndarray:
    """Return the ``count`` numbers of raw_data; raises ValueError where its bytes are not as many."""
    kind, size = runs.raw_data_type, len(runs.raw_data)
    if not 0 <= kind < len(_RAW_DTYPES):
        raise ValueError(f"found no data, and raw_data_type {kind}, expected 0 to {len(_RAW_DTYPES) - 1}")
    dtype = np.dtype(_RAW_DTYPES[kind])
    if size != count * dtype.itemsize:
        expected = f"expected {count * dtype.itemsize}, {count} numbers of {dtype.name}"
        raise ValueError(f"found no data, and {size} bytes of raw_data; {expected}")
    values = np.frombuffer(runs.raw_data, dtype)
    values = values if dtype.itemsize == 8 else values.astype("<f4")
    values.flags.writeable = False
    return values


def _runs_message() -> Any:
    """Return a message of BlobProto's wire format whose packed numbers are ``bytes``.

    protobuf writes repeated floats one Python object at a time (10 s for the 70 million of a net of the paper); as
    bytes, numpy writes them in place.
    """
    file = descriptor_pb2.FileDescriptorProto(name="netspec/blob_runs.proto", package="netspec")
    message = file.message_type.add(name="BlobRuns")
    field = descriptor_pb2.FieldDescriptorProto
    for name in _DATA + _DIFF:
        number = BlobProto.DESCRIPTOR.fields_by_name[name].number
        message.field.add(name=name, number=number, type=field.TYPE_BYTES, label=field.LABEL_OPTIONAL)
    kinds = ((*_RAW_TYPE, field.TYPE_INT32), (*_RAW_DATA, field.TYPE_BYTES))
    for name, number, kind in kinds:
        message.field.add(name=name, number=number, type=kind, label=field.LABEL_OPTIONAL)
    message.field.add(name="place", number=PLACE, type=field.TYPE_UINT64, label=field.LABEL_REPEATED)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("netspec.BlobRuns"))


_Runs = _runs_message()
