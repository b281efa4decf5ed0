"""The same program with OpenCV 4.12 (tests/golden/dnn/opencv.npz) and here."""

import json

import numpy as np
import pytest

import dnn_program
from netspec import dnn

pytestmark = pytest.mark.slow

OPENCV = dict(np.load(dnn_program.HERE / "opencv.npz"))


@pytest.fixture(scope="module")
def ours() -> dict[str, np.ndarray]:
    return dnn_program.record(dnn)


def test_the_same_properties_are_found(ours: dict[str, np.ndarray]) -> None:
    assert sorted(ours) == sorted(OPENCV)


@pytest.mark.parametrize("key", sorted(OPENCV))
def test_equals_opencv(ours: dict[str, np.ndarray], key: str) -> None:
    found, expected = ours[key], OPENCV[key]
    assert found.shape == expected.shape
    if expected.dtype.kind == "f":
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * max(1.0, float(abs(expected).max())))
    elif expected.dtype.kind == "U" and expected.ndim == 0:
        assert json.loads(str(found)) == json.loads(str(expected))
    else:
        np.testing.assert_array_equal(found, expected)
