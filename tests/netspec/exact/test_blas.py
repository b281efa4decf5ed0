"""The routines of BLAS compute the documented products and sums."""

from itertools import product

import numpy as np
import pytest
import torch

from netspec.exact.blas import add_sums, dot, dots, gemm, sum_in_order, sum_of_magnitudes, sum_of_squares

TYPES = [torch.float32, torch.float64]


SIZES = [(2, 3, 4), (1, 1, 1), (5, 1, 7), (1, 6, 1), (40, 300, 50)]


@pytest.mark.parametrize(("dtype", "a_t", "b_t", "sizes"), [*product(TYPES, (False, True), (False, True), SIZES)])
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
def test_gemm_multiplies_stacks_one_by_one(dtype: torch.dtype) -> None:
    """Bit for bit what single products are; stacks may lie apart, as groups of channels do."""
    a, b = torch.randn(3, 2, 4, 5, dtype=dtype)[:, 1], torch.randn(3, 5, 6, dtype=dtype)
    c, one_by_one = torch.zeros(3, 4, 6, dtype=dtype), torch.zeros(3, 4, 6, dtype=dtype)
    gemm(a, b, c)
    for matrices in zip(a, b, one_by_one, strict=True):
        gemm(*matrices)
    assert torch.equal(c, one_by_one)
    total, added = torch.ones(2, 4, 6, dtype=dtype)
    gemm(a, b, total, add=True)
    for first, second in zip(a, b, strict=True):
        gemm(first, second, added, add=True)
    assert torch.equal(total, added)
    torch.testing.assert_close(total, 1 + (a @ b).sum(0))


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("axis", [0, 1])
def test_add_sums_of_stacks(dtype: torch.dtype, axis: int) -> None:
    a = torch.randn(3, 4, 5, dtype=dtype)
    total, own = torch.ones(a.shape[2 - axis], dtype=dtype), torch.ones(3, a.shape[2 - axis], dtype=dtype)
    add_sums(a, total, axis)
    add_sums(a, own, axis)
    torch.testing.assert_close(total, 1 + a.sum((0, 1 + axis)))
    torch.testing.assert_close(own, 1 + a.sum(1 + axis))


def test_matrices_with_gaps_are_read_but_not_written() -> None:
    whole, c = torch.randn(4, 8), torch.zeros(4, 4)
    a, sums = whole[:, :4], torch.zeros(4)
    gemm(a, a, c)
    add_sums(a, sums, 0)
    torch.testing.assert_close(c, a @ a)
    torch.testing.assert_close(sums, a.sum(0))
    with pytest.raises(AssertionError, match="the rows of a matrix must be contiguous"):
        gemm(c, c, a)


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


@pytest.mark.parametrize("dtype", TYPES)
def test_products_with_a_vector_and_magnitudes(dtype: torch.dtype) -> None:
    a, b = torch.randn(2, 5, 7, dtype=dtype)
    torch.testing.assert_close(dot(a, b), (a * b).sum())
    torch.testing.assert_close(sum_of_magnitudes(a), a.abs().sum())


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("shape", [(2, 5, 3), (4, 6, 1), (3, 40, 1), (2, 50, 2), (1, 1, 1)])
def test_dots_along_the_middle_axis(dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    a, b = torch.randn(2, *shape, dtype=dtype)
    torch.testing.assert_close(dots(a, b), (a * b).sum(1))


@pytest.mark.parametrize("length", [1, 7, 31, 32, 33, 500])
def test_dots_have_the_bits_of_a_dot(length: int, caffes_bits: bool) -> None:
    a, b = torch.randn(2, 20, length)
    expected = torch.stack([dot(x, y) for x, y in zip(a, b, strict=True)])
    found = dots(a.unsqueeze(2), b.unsqueeze(2)).squeeze(1)
    torch.testing.assert_close(found, expected)
    assert torch.equal(found, expected) or not caffes_bits  # another CPU's BLAS may sum otherwise


@pytest.mark.parametrize("count", [1, 2, 1000])
def test_sum_in_order_is_a_plain_loop(count: int) -> None:
    values = torch.rand(count)
    total = np.float32(0)
    for value in values.numpy():
        total += value
    assert sum_in_order(values).item() == total
