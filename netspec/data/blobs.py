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
from netspec.proto.wire import POSITION, fields

Shape = tuple[int, ...]
LEGACY_AXES = ("num", "channels", "height", "width")
_AT_ONCE = 1 << 20  # numbers to read at once, so that the next copy finds them in the CPU's cache
_DATA, _DIFF = ("data", "double_data"), ("diff", "double_diff")

# NVIDIA Caffe, DIGITS 6 and OpenCV's half-precision tools write a BlobProto with `raw_data_type`, an enum, and
# `raw_data`, little-endian bytes, instead of `data`.
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

    An old 4-D shape fits a shape with fewer axes if they differ only by leading ones: (1, 1, 1, 500) fits (500,).
    """
    if is_legacy(proto):
        return len(shape) <= 4 and shape_of(proto) == (1,) * (4 - len(shape)) + tuple(shape)
    return shape_of(proto) == tuple(shape)


def to_array(proto: Any) -> np.ndarray:
    """Return the values in the blob's shape: float32, or float64 for a blob of doubles. The array is read-only.

    If the blob has neither data nor double_data, the numbers in its raw_data are returned; half precision and
    integers become float32. Raises ValueError if the number of values does not match the shape.
    """
    name, dtype = ("double_data", "<f8") if len(proto.double_data) else ("data", "<f4")
    found, shape = len(getattr(proto, name)), shape_of(proto)
    count, stored = math.prod(shape), proto.SerializeToString()
    if not found and count and (runs := _Runs.FromString(stored)).raw_data:
        return _raw_values(runs, count).reshape(shape)
    _check_count(found, name, shape)
    number = BlobProto.DESCRIPTOR.fields_by_name[name].number
    start = next((field.start for field in fields(stored, 0, len(stored)) if field.number == number), 0)
    return np.frombuffer(stored, dtype, count, start).reshape(shape)


def from_array(values: np.ndarray, diff: np.ndarray | None = None) -> Any:
    """Return a BlobProto with the values and their gradient: float32 as in Caffe, or doubles for float64."""
    wide = values.dtype == np.float64
    given = {names[wide]: array for array, names in ((values, _DATA), (diff, _DIFF)) if array is not None}
    dtype = "<f8" if wide else "<f4"
    return _blob(values.shape, **{name: np.ascontiguousarray(each, dtype).tobytes() for name, each in given.items()})


def in_half_precision(values: np.ndarray) -> Any:
    """Return a BlobProto with the values in half precision as raw_data, as NVIDIA Caffe and OpenCV write it."""
    return _blob(values.shape, raw_data_type=_RAW_DTYPES.index("<f2"), raw_data=values.astype("<f2").tobytes())


def _blob(shape: Shape, **runs: Any) -> Any:
    """Return a BlobProto with these fields of _Runs. As in Caffe, ``shape`` is absent if there are no axes."""
    proto = BlobProto(shape=BlobShape(dim=shape)) if shape else BlobProto()
    proto.MergeFromString(_Runs(**runs).SerializeToString())
    return proto


def _check_count(found: int, name: str, shape: Shape) -> None:
    if found != math.prod(shape):
        raise ValueError(f"found {found} numbers in {name}, expected {math.prod(shape)} for shape {shape}")


class InFile(NamedTuple):
    """Numbers that are still in a file (little-endian float32): their position and shape."""

    file: BinaryIO
    start: int
    shape: Shape

    def parts(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield all numbers in order, in parts, each with the number of values before it.

        A part is valid until the next one. Raises OSError if they cannot be read, ValueError for a truncated file.
        """
        count = math.prod(self.shape)
        part = np.empty(min(_AT_ONCE, count), "<f4")
        self.file.seek(self.start)
        for done in range(0, count, len(part)):
            here = part[: count - done]
            if self.file.readinto(memoryview(here).cast("B")) < here.nbytes:  # type: ignore[attr-defined]
                raise ValueError("was truncated by another program while it was being read")
            yield done, here


def in_file(proto: Any, file: BinaryIO | None) -> InFile | None:
    """Return the position of a blob's numbers in the file; None if the blob itself contains the numbers.

    Raises ValueError as :func:`to_array`.
    """
    position = _Runs.FromString(proto.SerializeToString()).position if file and not proto.data else ()
    if not file or not position:
        return None
    start, size = position
    _check_count(size // 4, "data", shape_of(proto))
    return InFile(file, start, shape_of(proto))


def _raw_values(runs: Any, count: int) -> np.ndarray:
    """Return the ``count`` numbers of raw_data; raises ValueError if its size does not match."""
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
    """Return a message with BlobProto's wire format whose packed numbers are ``bytes``.

    protobuf writes repeated floats one Python object at a time (10 s for the 70 million of a net in the paper). As
    bytes, numpy can write them in place.
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
    message.field.add(name="position", number=POSITION, type=field.TYPE_UINT64, label=field.LABEL_REPEATED)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("netspec.BlobRuns"))


_Runs = _runs_message()
