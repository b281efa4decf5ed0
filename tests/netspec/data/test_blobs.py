import numpy as np
import pytest

from netspec.data import blobs
from netspec.proto.schema import BlobProto, BlobShape


def test_values_and_gradient_survive_the_round_trip():
    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    proto = BlobProto.FromString(blobs.from_array(values, diff=-values).SerializeToString())
    assert list(proto.shape.dim) == [2, 3, 4]
    assert list(proto.data) == list(range(24))
    np.testing.assert_array_equal(blobs.to_array(proto), values)
    np.testing.assert_array_equal(blobs.diff_to_array(proto), -values)
    assert blobs.to_array(proto).dtype == np.float32


def test_doubles_stay_doubles():
    values = np.array([[np.pi], [np.e]])
    proto = blobs.from_array(values, diff=values)
    assert list(proto.double_data) == [np.pi, np.e]
    assert not proto.data
    assert blobs.to_array(proto).dtype == np.float64
    np.testing.assert_array_equal(blobs.diff_to_array(proto), values)


def test_what_protobuf_itself_writes_is_read():
    proto = BlobProto(shape=BlobShape(dim=[3]), data=[1.5, -2.5, 1e-30])
    np.testing.assert_array_equal(blobs.to_array(proto), np.array([1.5, -2.5, 1e-30], np.float32))
    assert blobs.diff_to_array(proto) is None


def test_a_transposed_array_is_written_in_its_own_order():
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
def test_an_old_shape_fits_one_with_fewer_axes(old: tuple[int, ...], shape: tuple[int, ...], fitting: bool):
    proto = BlobProto(num=old[0], channels=old[1], height=old[2], width=old[3])
    assert blobs.fits(proto, shape) is fitting


def test_a_new_shape_fits_itself_only():
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
