"""The functions are the C library's, to the last bit."""

import ctypes

import numpy as np
import pytest
import torch

from netspec.exact import libm

WIDE = np.array(
    [0, -0.0, 1e-45, 1e-38, 87.9, 88.0, 88.1, 88.7, -88, -103.9, -104, 1e-8, -1e-8, 0.5, -0.5, 20, -20], np.float32
)
SHAPES = [(), (1,), (2,), (17,), (3, 5, 7), (4099,)]


def each(name: str, kind: type, values: torch.Tensor, *others: float) -> np.ndarray:
    """Call a function of the C library for each value."""
    function = getattr(ctypes.CDLL(None), name)
    function.restype, function.argtypes = kind, [kind] * (1 + len(others))
    found = [function(value, *others) for value in values.flatten().tolist()]
    return np.array(found, values.numpy().dtype).reshape(values.shape)


def values_of(shape: tuple[int, ...]) -> torch.Tensor:
    return torch.randn(shape) * 8


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("function", "name"), [(libm.exp, "expf"), (libm.tanh, "tanhf")])
def test_of_any_float(function, name: str, shape: tuple[int, ...]) -> None:
    for values in (values_of(shape), torch.from_numpy(WIDE)):
        found = function(values)
        assert found.dtype == torch.float32
        assert found.is_contiguous()
        np.testing.assert_array_equal(found, each(name, ctypes.c_float, values))


@pytest.mark.parametrize("shape", SHAPES)
def test_of_positive_floats(shape: tuple[int, ...]) -> None:
    values = values_of(shape).abs()
    np.testing.assert_array_equal(libm.log(values), each("logf", ctypes.c_float, values))
    np.testing.assert_array_equal(libm.sqrt(values), each("sqrtf", ctypes.c_float, values))
    for exponent in (2.0, 0.5, -0.75, -1.0):
        np.testing.assert_array_equal(libm.power(values, exponent), each("powf", ctypes.c_float, values, exponent))


@pytest.mark.parametrize(("function", "name"), [(libm.exp, "exp"), (libm.tanh, "tanh"), (libm.log, "log")])
def test_of_doubles(function, name: str) -> None:
    values = values_of((1000,)).double().abs()
    np.testing.assert_array_equal(function(values), each(name, ctypes.c_double, values))


def test_sigmoid_is_computed_in_double() -> None:
    values = values_of((1000,))
    expected = 0.5 * each("tanh", ctypes.c_double, 0.5 * values.double()) + 0.5
    np.testing.assert_array_equal(libm.sigmoid(values), expected.astype(np.float32))


def test_what_is_not_on_the_cpu_gets_torchs_functions() -> None:
    values = torch.ones(3, device="meta")
    for function in (libm.exp, libm.log, libm.sqrt, libm.tanh, libm.sigmoid):
        assert function(values).device.type == "meta"
    assert libm.power(values, 0.5).device.type == "meta"
