"""The functions are the C library's, to the last bit; tanhf is that of glibc up to 2.40, whatever is installed."""

import ctypes
import hashlib
import platform

import numpy as np
import pytest
import torch

from netspec.exact import libm, machine
from netspec.exact.machine import digests

LIBRARY, VERSION = platform.libc_ver()  # ("glibc", "2.36"); of another C library ("", "")
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
def test_exponential_of_floats(shape: tuple[int, ...]) -> None:
    for values in (values_of(shape), torch.from_numpy(WIDE)):
        found = libm.exp(values)
        assert found.dtype == torch.float32
        assert found.is_contiguous()
        np.testing.assert_array_equal(found, each("expf", ctypes.c_float, values))


def test_tanh_of_a_million_floats_has_the_bits_of_glibc_2_36() -> None:
    """Of each 4099th float; the digest was computed with tanhf of glibc 2.36."""
    values = np.arange(0, 2**32, 4099, dtype=np.uint32).view(np.float32)
    found = libm.tanh(torch.from_numpy(values[~np.isnan(values)])).numpy()
    expected = "1a5350336c2f1e386ed0ada012ce16ee702f23c2710c6352d3599ba995fbd28b"
    assert hashlib.sha256(found.astype("<f4").tobytes()).hexdigest() == expected


@pytest.mark.skipif(LIBRARY != "glibc", reason="another C library may round differently")
def test_the_functions_have_the_bits_of_the_golden_files() -> None:
    assert digests() == machine._GLIBCS


def test_exponential_of_large_floats_without_the_c_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows cannot look up a function of the program itself; then a double is rounded."""

    def refuse(name: None) -> None:
        raise TypeError("argument of type 'NoneType' is not iterable")

    values = torch.tensor([88.5, 89, -1, 3])
    expected = libm.exp(values)
    monkeypatch.setattr(ctypes, "CDLL", refuse)
    libm._expf.cache_clear()
    try:
        torch.testing.assert_close(libm.exp(values), expected, rtol=1e-7, atol=0)
    finally:
        libm._expf.cache_clear()


@pytest.mark.skipif(
    LIBRARY != "glibc" or tuple(map(int, VERSION.split("."))) >= (2, 41),
    reason="its tanhf has other bits",
)
def test_tanh_equals_an_older_glibcs() -> None:
    values = torch.cat([values_of((20000,)), torch.rand(20000) * 2 - 1, torch.from_numpy(WIDE)])
    np.testing.assert_array_equal(libm.tanh(values), each("tanhf", ctypes.c_float, values))


@pytest.mark.parametrize("shape", SHAPES)
def test_tanh_of_any_shape(shape: tuple[int, ...]) -> None:
    values = values_of(shape)
    found = libm.tanh(values)
    assert found.dtype == torch.float32
    assert found.is_contiguous()
    assert found.shape == shape
    torch.testing.assert_close(found, values.tanh())


def test_tanh_of_no_number_and_of_infinity() -> None:
    found = libm.tanh(torch.tensor([float("nan"), float("inf"), -float("inf"), -0.0]))
    np.testing.assert_array_equal(found, np.array([np.nan, 1, -1, 0], np.float32))
    assert found[3].signbit()


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


def test_tensors_on_other_devices_use_torchs_functions() -> None:
    values = torch.ones(3, device="meta")
    for function in (libm.exp, libm.log, libm.sqrt, libm.tanh, libm.sigmoid):
        assert function(values).device.type == "meta"
    assert libm.power(values, 0.5).device.type == "meta"
