from __future__ import annotations

import cv2
import numpy as np
import pytest

from netspec.data.datum import array_to_datum, datum_to_array, encoded_datum
from netspec.proto.schema import Datum

COLORS = np.random.default_rng(0).integers(0, 256, (3, 5, 7), np.uint8)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image.transpose(1, 2, 0))[1].tobytes()


def test_floats_are_stored_in_float_data() -> None:
    values = np.linspace(-2, 2, 24, dtype=np.float64).reshape(2, 3, 4)
    datum = array_to_datum(values)
    assert not datum.HasField("data")
    assert not datum.HasField("label")
    found = datum_to_array(datum)
    assert found.dtype == np.float32
    assert (found == values.astype(np.float32)).all()


def test_data_has_priority_over_float_data() -> None:  # data_transformer.cpp:53
    datum = Datum(channels=1, height=1, width=2, data=b"\x05\xff", float_data=[1.5, 2.5])
    assert datum_to_array(datum).tolist() == [[[5, 255]]]


@pytest.mark.parametrize(("color", "channels"), [(None, 3), (True, 3), (False, 1)])
def test_encoded_images_are_decoded_in_color_or_gray(color: bool | None, channels: int) -> None:
    found = datum_to_array(encoded_datum(png(COLORS), 1), color)
    assert found.shape == (channels, 5, 7)
    if channels == 3:
        assert (found == COLORS).all()


def test_a_gray_file_stays_gray_unless_color_is_forced() -> None:
    datum = encoded_datum(png(COLORS[:1]))
    assert (datum_to_array(datum) == COLORS[:1]).all()
    assert (datum_to_array(datum, color=True) == COLORS[[0, 0, 0]]).all()


@pytest.mark.parametrize(
    ("datum", "message"),
    [
        (Datum(channels=3, height=2, width=2, data=b"1234"), "contains 4 values in data, but .* is 3 x 2 x 2"),
        (Datum(channels=1, height=2, width=2, float_data=[1.0]), "contains 1 values in float_data"),
        (Datum(), "contains 0 values"),
        (Datum(encoded=True, data=b"no image"), "cannot be decoded"),
        (Datum(encoded=True), "cannot be decoded"),
        (encoded_datum(cv2.imencode(".png", np.zeros((2, 2), np.uint16))[1].tobytes()), "uint16 .* only 8 bits"),
    ],
)
def test_contradictions_are_reported(datum: Datum, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        datum_to_array(datum)


def test_an_array_needs_three_axes() -> None:
    with pytest.raises(ValueError, match="channels x height x width"):
        array_to_datum(np.zeros((2, 2), np.uint8))
