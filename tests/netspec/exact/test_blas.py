"""The arithmetic that gives Caffe's bits: that it computes what it says, and where it adds."""

import ctypes
import ctypes.util

import numpy as np
import pytest
import torch

from netspec.exact.blas import add_sums, adding_to_grad, gemm, power, sum_in_order, sum_of_squares

TYPES = [torch.float32, torch.float64]


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("a_t", [False, True])
@pytest.mark.parametrize("b_t", [False, True])
@pytest.mark.parametrize("sizes", [(2, 3, 4), (1, 1, 1), (5, 1, 7), (1, 6, 1), (40, 300, 50)])
def test_gemm_multiplies_and_adds_in_place(
    dtype: torch.dtype, a_t: bool, b_t: bool, sizes: tuple[int, int, int]
) -> None:
    m, k, n = sizes
    a, b = torch.randn(k, m, dtype=dtype) if a_t else torch.randn(m, k, dtype=dtype), torch.randn(k, n, dtype=dtype)
    expected = (a.T if a_t else a) @ b
    b = b.T.contiguous() if b_t else b
    c = torch.full((m, n), torch.nan, dtype=dtype)  # what was there must not count
    gemm(a, b, c, a_t=a_t, b_t=b_t)
    torch.testing.assert_close(c, expected, rtol=1e-4, atol=1e-4)
    gemm(a, b, c, a_t=a_t, b_t=b_t, add=True)
    torch.testing.assert_close(c, 2 * expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("shape", [(3, 5), (1, 4), (4, 1), (1, 1)])
def test_add_sums(dtype: torch.dtype, axis: int, shape: tuple[int, int]) -> None:
    a = torch.randn(shape, dtype=dtype)
    sums = torch.ones(shape[1 - axis], dtype=dtype)
    add_sums(a, sums, axis)
    torch.testing.assert_close(sums, 1 + a.sum(axis))


@pytest.mark.parametrize("dtype", TYPES)
def test_sum_of_squares(dtype: torch.dtype) -> None:
    values = torch.randn(5, 7, dtype=dtype)
    torch.testing.assert_close(sum_of_squares(values), values.square().sum())


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_sum_in_order_is_a_plain_loop(count: int) -> None:
    values = torch.rand(count)
    total = np.float32(0)
    for value in values.numpy():
        total += value
    assert sum_in_order(values).item() == total


@pytest.mark.parametrize("exponent", [2.0, 0.5, -0.75])
@pytest.mark.parametrize("shape", [(), (1,), (2,), (17,), (3, 5, 7), (4099,)])
def test_power_is_the_c_librarys_powf(exponent: float, shape: tuple[int, ...]) -> None:
    library = ctypes.util.find_library("m")
    if library is None:
        pytest.skip("no C library of mathematics to compare with")
    powf = ctypes.CDLL(library).powf
    powf.restype, powf.argtypes = ctypes.c_float, [ctypes.c_float, ctypes.c_float]
    values = torch.rand(shape) * 3
    expected = np.array([powf(value, exponent) for value in values.flatten().tolist()], np.float32)
    found = power(values, exponent)
    assert found.shape == values.shape
    np.testing.assert_array_equal(found.flatten(), expected)


SIAMESE = """
    layer { name: "data" type: "Input" top: "a" top: "b"
            input_param { shape { dim: 2 dim: 1 dim: 4 dim: 4 } shape { dim: 2 dim: 1 dim: 4 dim: 4 } } }
    layer { name: "conv" type: "Convolution" bottom: "a" top: "conv" param { name: "w" } param { name: "v" }
            convolution_param { num_output: 2 kernel_size: 3 weight_filler { type: "gaussian" } } }
    layer { name: "ip" type: "InnerProduct" bottom: "conv" top: "ip" param { name: "x" } param { name: "y" }
            inner_product_param { num_output: 3 weight_filler { type: "gaussian" } } }
    layer { name: "conv_p" type: "Convolution" bottom: "b" top: "conv_p" param { name: "w" } param { name: "v" }
            convolution_param { num_output: 2 kernel_size: 3 } }
    layer { name: "ip_p" type: "InnerProduct" bottom: "conv_p" top: "ip_p" param { name: "x" } param { name: "y" }
            inner_product_param { num_output: 3 } }
    layer { name: "loss" type: "EuclideanLoss" bottom: "ip" bottom: "ip_p" top: "loss" }
"""


def test_adding_to_grad_adds_pass_after_pass_what_autograd_would(net_of) -> None:
    net = net_of(SIAMESE, phase=0)
    inputs = {name: torch.randn(2, 1, 4, 4) for name in "ab"}
    parameters = [item.parameter for item in net.learnable]
    expected = torch.autograd.grad(net.forward_loss(**inputs)[0], parameters)
    assert all(parameter.grad is None for parameter in parameters)
    for passes in (1, 2):
        with adding_to_grad():
            net.forward_loss(**inputs)[0].backward()
        for parameter, one in zip(parameters, expected, strict=True):
            torch.testing.assert_close(parameter.grad, passes * one)
    net.forward_loss(**inputs)[0].backward()  # outside, autograd adds
    for parameter, one in zip(parameters, expected, strict=True):
        torch.testing.assert_close(parameter.grad, 3 * one)


def test_no_image_is_no_fault(net_of) -> None:
    assert net_of(SIAMESE).layers[2].run(torch.zeros(0, 2, 2, 2))[0].shape == (0, 3)


def test_frozen_parameters_get_no_gradient(net_of) -> None:
    net = net_of(SIAMESE.replace('"w" }', '"w" lr_mult: 0 }').replace('"y" }', '"y" lr_mult: 0 }'), phase=0)
    with adding_to_grad():
        net.forward_loss(**{name: torch.randn(2, 1, 4, 4) for name in "ab"})[0].backward()
    assert [item.parameter.grad is None for item in net.learnable] == [True, False, False, True]


@pytest.mark.filterwarnings("ignore")  # torch.jit.trace is deprecated, but in use
def test_a_recorded_net_computes_and_does_not_remember(net_of) -> None:
    net = net_of(SIAMESE)
    layer, data = net.layers[1], torch.randn(2, 1, 4, 4)
    other = torch.randn(2, 1, 4, 4)
    for recorded in (torch.jit.trace(layer, data, check_trace=False), torch.export.export(layer, (data,)).module()):
        torch.testing.assert_close(recorded(other), layer(other))
