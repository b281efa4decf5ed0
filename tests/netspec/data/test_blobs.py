import numpy as np
import pytest

from netspec.data import blobs
from netspec.proto.schema import BlobProto, BlobShape
from wire import field


def test_doubles_are_kept():
    values = np.array([[np.pi], [np.e]])
    proto = blobs.from_array(values, diff=values)
    assert list(proto.double_data) == [np.pi, np.e]
    assert not proto.data
    assert blobs.to_array(proto).dtype == np.float64
    np.testing.assert_array_equal(np.array(proto.double_diff).reshape(2, 1), values)


def test_a_transposed_array_is_written_in_row_major_order():
    values = np.arange(6, dtype=np.float32).reshape(2, 3).T
    np.testing.assert_array_equal(blobs.to_array(blobs.from_array(values)), values)


def test_the_four_old_fields_give_the_shape():
    proto = BlobProto(num=2, channels=1, height=1, width=3, data=range(6))
    assert blobs.shape_of(proto) == (2, 1, 1, 3)
    assert blobs.to_array(proto).shape == (2, 1, 1, 3)
    assert blobs.shape_of(BlobProto(width=3)) == (0, 0, 0, 3)


@pytest.mark.parametrize(
    ("old", "shape", "fitting"),
    [
        ((1, 1, 1, 500), (500,), True),
        ((1, 1, 10, 500), (10, 500), True),
        ((20, 1, 5, 5), (20, 1, 5, 5), True),
        ((500, 1, 1, 1), (500,), False),
        ((1, 1, 1, 500), (1, 1, 1, 1, 500), False),
    ],
)
def test_an_old_shape_fits_a_shape_with_fewer_axes(old: tuple[int, ...], shape: tuple[int, ...], fitting: bool):
    proto = BlobProto(num=old[0], channels=old[1], height=old[2], width=old[3])
    assert blobs.fits(proto, shape) is fitting


def test_a_new_shape_fits_only_itself():
    proto = BlobProto(shape=BlobShape(dim=[1, 500]))
    assert blobs.fits(proto, (1, 500))
    assert not blobs.fits(proto, (500,))


def test_a_scalar_and_an_empty_blob():
    assert blobs.to_array(blobs.from_array(np.float32(7).reshape(()))) == 7
    assert blobs.to_array(blobs.from_array(np.zeros((0, 3), np.float32))).shape == (0, 3)


def test_too_few_numbers_for_the_shape_are_refused():
    proto = BlobProto(shape=BlobShape(dim=[2, 2]), data=[1, 2, 3])
    with pytest.raises(ValueError, match=r"found 3 numbers in data, expected 4 for shape \(2, 2\)"):
        blobs.to_array(proto)


def with_raw(proto: BlobProto, kind: int | None, raw: bytes) -> BlobProto:
    """Append raw_data_type (field 10, a varint) and raw_data (field 12, bytes) on the wire."""
    number = b"" if kind is None else bytes([10 << 3, kind])
    return BlobProto.FromString(proto.SerializeToString() + number + field(12, raw))


@pytest.mark.parametrize(
    ("kind", "dtype", "found"),
    [
        (0, "<f8", np.float64),
        (None, "<f8", np.float64),
        (1, "<f4", np.float32),
        (2, "<f2", np.float32),
        (3, "<i4", np.float32),
        (4, "<u4", np.float32),
    ],
)
def test_numbers_of_raw_data_are_read(kind: int | None, dtype: str, found: type):
    values = np.array([[1, 2, 3], [4, 500, 6]], dtype)
    proto = with_raw(BlobProto(shape=BlobShape(dim=[2, 3])), kind, values.tobytes())
    np.testing.assert_array_equal(blobs.to_array(proto), values)
    assert blobs.to_array(proto).dtype == found
    assert not proto.diff
    assert not proto.double_diff


def test_half_precision_is_read_exactly():
    values = np.array([-0.1, 65504, 6e-8, -0.0], "<f2")
    proto = with_raw(BlobProto(num=1, channels=1, height=1, width=4), 2, values.tobytes())
    np.testing.assert_array_equal(blobs.to_array(proto)[0, 0, 0], values.astype(np.float32))


def test_data_has_priority_over_fields_numbered_like_raw_data():
    data = BlobProto(shape=BlobShape(dim=[2]), data=[1, 2])
    np.testing.assert_array_equal(blobs.to_array(with_raw(data, 1, np.array([7, 8], "<f4").tobytes())), [1, 2])
    number_12_is_a_varint = data.SerializeToString() + field(10, b"A") + bytes([12 << 3, 9])
    np.testing.assert_array_equal(blobs.to_array(BlobProto.FromString(number_12_is_a_varint)), [1, 2])


def test_raw_data_that_does_not_fit_is_refused():
    empty = BlobProto(shape=BlobShape(dim=[3]))
    with pytest.raises(ValueError, match="found no data, and 4 bytes of raw_data; expected 6, 3 numbers of float16"):
        blobs.to_array(with_raw(empty, 2, b"abcd"))
    with pytest.raises(ValueError, match="raw_data_type 9, expected 0 to 4"):
        blobs.to_array(with_raw(empty, 9, b"abcd"))
    with pytest.raises(ValueError, match="found 0 numbers in data, expected 3"):
        blobs.to_array(empty)
