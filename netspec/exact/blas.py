"""Caffe's calls of BLAS, with SciPy's OpenBLAS. On the same kind of CPU, equal calls return equal bits.

Caffe: src/caffe/util/math_functions.cpp
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from typing import Any

import numpy as np
import scipy
import torch

from netspec.exact import ALL, SMALL
from netspec.files.environment import environment

with environment({"KMP_DUPLICATE_LIB_OK": "True"}):  # importing it sets this variable permanently
    from threadpoolctl import ThreadpoolController

CAFFES = "SkylakeX"  # OpenBLAS' name of its kernels for AVX-512, with which the golden files were computed
CORE_TYPE = "OPENBLAS_CORETYPE"  # the environment variable by which OpenBLAS chooses its kernels, when it is loaded


@cache
def _library() -> Any:
    """Return SciPy's BLAS for addresses, with Caffe's kernels, for AVX-512.

    OpenBLAS chooses others on some newer CPUs. A choice in the environment is kept, and so are the kernels of a BLAS of
    SciPy that was loaded before. Only this module of ``scipy.linalg`` is loaded, because all of it takes ten times as
    long. It is removed from ``sys.modules``; otherwise a later import of ``scipy.linalg`` would lack it as an
    attribute.
    """
    name = "scipy.linalg.cython_blas"
    if name in sys.modules:
        return sys.modules[name]
    spec = PathFinder.find_spec(name, [f"{folder}/linalg" for folder in scipy.__path__])
    assert spec, f"this SciPy has no {name}"
    assert spec.loader
    with environment({CORE_TYPE: CAFFES} if torch.backends.cpu.get_cpu_capability() == "AVX512" else {}):
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
    sys.modules.pop(name, None)
    return module


_IN_DOUBLE = 32  # OpenBLAS' dot sums up fewer products than this in double, one by one


def suits_blas(tensor: torch.Tensor) -> bool:
    """Return whether the functions of this module accept a tensor: on the CPU, float32 or float64, not empty."""
    return tensor.device.type == "cpu" and tensor.dtype in (torch.float32, torch.float64) and tensor.numel() > 0


def applies(exact: str, values: torch.Tensor, small: bool = False) -> bool:
    """Return whether to use Caffe's order: if ``exact`` is "all", or if it is "small" and the work is ``small``.

    Never while operations are recorded, because Caffe's order is computed with numpy, which cannot be recorded.
    """
    if exact != ALL and not (small and exact == SMALL):
        return False
    return suits_blas(values) and not is_recorded()


def is_recorded() -> bool:
    """Return whether operations are recorded (traced or compiled), not only run."""
    return torch.compiler.is_compiling() or torch.jit.is_tracing()  # pyright: ignore[reportPrivateImportUsage]


def array(values: torch.Tensor) -> np.ndarray:
    """Return values on the CPU as an array that shares their memory."""
    return values.detach().numpy()


@contextmanager
def one_thread() -> Iterator[None]:
    """A block in which BLAS uses one thread. More threads would busy-wait, like torch's, and slow each other down."""
    before = [(pool, count) for pool in _pools() if (count := pool.get_num_threads()) != 1]
    for pool, _ in before:
        pool.set_num_threads(1)
    try:
        yield
    finally:
        for pool, count in before:
            pool.set_num_threads(count)


def gemm(
    a: torch.Tensor, b: torch.Tensor, c: torch.Tensor, *, a_t: bool = False, b_t: bool = False, add: bool = False
) -> None:
    """C = A B, or C += A B; ``a_t`` and ``b_t`` take the transposes of what is stored (caffe_cpu_gemm).

    All three are matrices, C stored row by row without gaps. BLAS stores by columns, so it sees their transposes.
    Stacks of matrices (N, rows, columns) are multiplied one after the other, as Caffe does image by image. A single
    matrix A or B is used N times. To a single matrix C, with ``add``, all products are added.
    """
    a, b = _without_gaps(a), _without_gaps(b)
    assert _without_gaps(c) is c, "the rows of a matrix must be contiguous"
    call = _gemm(c.dtype, b_t, a_t, c.shape[-1], c.shape[-2], a.shape[-2 if a_t else -1], add)
    at_a, at_b, at_c = a.data_ptr(), b.data_ptr(), c.data_ptr()
    step_a, step_b, step_c = _step(a), _step(b), _step(c)
    for _ in range(_count(a, b, c)):
        call(at_b, at_a, at_c)
        at_a, at_b, at_c = at_a + step_a, at_b + step_b, at_c + step_c


@lru_cache(maxsize=1024)
def _gemm(
    dtype: torch.dtype, first_t: bool, second_t: bool, rows: int, columns: int, length: int, add: bool
) -> Callable[[int, int, int], None]:
    """Return gemm for the addresses of two matrices and their product, all stored by columns."""
    call, number = _function("gemm", dtype), _NUMBERS[dtype]
    flags = [ctypes.create_string_buffer(b"T" if t else b"N") for t in (first_t, second_t)]
    leading = (length if first_t else rows, columns if second_t else length, rows)
    kept = (*flags, *map(ctypes.c_int, (rows, columns, length, *leading)), number(1), number(add))
    *head, of_first, of_second, of_product, alpha, beta = map(ctypes.addressof, kept)

    def run(first: int, second: int, product: int, _: Any = kept) -> None:
        call(*head, alpha, first, of_first, second, of_second, beta, product, of_product)

    return run


def add_sums(a: torch.Tensor, sums: torch.Tensor, axis: int, factor: float = 1.0) -> None:
    """Add the sums of matrix A along an axis, times a factor, as its product with a vector of ones (caffe_cpu_gemv).

    For a stack of matrices (N, rows, columns), the sums of each matrix are added in turn, all to the same ``sums``. If
    ``sums`` has two axes (N, ...), each matrix has its own row.
    """
    a = _without_gaps(a)
    ones = torch.ones(a.shape[axis - 2], dtype=a.dtype)
    call = _gemv(a.dtype, axis == 1, a.shape[-1], a.shape[-2], factor)
    at_ones, at_a, at_sums, step_a = ones.data_ptr(), a.data_ptr(), sums.data_ptr(), _step(a)
    step_sums = sums.stride(0) * sums.element_size() if sums.dim() == 2 else 0
    for _ in range(_count(a)):
        call(at_a, at_ones, at_sums)
        at_a, at_sums = at_a + step_a, at_sums + step_sums


@lru_cache(maxsize=1024)
def _gemv(
    dtype: torch.dtype, transposed: bool, rows: int, columns: int, factor: float
) -> Callable[[int, int, int], None]:
    """Return gemv for the addresses of a matrix, stored by columns, of a vector and of the sums to add to."""
    call, number = _function("gemv", dtype), _NUMBERS[dtype]
    flag = ctypes.create_string_buffer(b"T" if transposed else b"N")
    kept = (flag, ctypes.c_int(rows), ctypes.c_int(columns), number(factor), ctypes.c_int(1), number(1))
    flag_at, rows_at, columns_at, alpha, one, beta = map(ctypes.addressof, kept)

    def run(matrix: int, vector: int, sums: int, _: Any = kept) -> None:
        call(flag_at, rows_at, columns_at, alpha, matrix, rows_at, vector, one, beta, sums, one)

    return run


_NUMBERS = {torch.float32: ctypes.c_float, torch.float64: ctypes.c_double}
_ARGUMENTS = {"gemm": 13, "gemv": 11, "dot": 5, "asum": 3}


@cache
def _function(name: str, dtype: torch.dtype) -> Callable[..., Any]:
    """Return a Fortran routine of SciPy's BLAS. Its arguments are addresses; dot and asum return a number."""
    capsule = _library().__pyx_capi__[("s" if dtype == torch.float32 else "d") + name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    address = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    result = _NUMBERS[dtype] if name in ("dot", "asum") else None
    return ctypes.PYFUNCTYPE(result, *[ctypes.c_void_p] * _ARGUMENTS[name])(address)


def _count(*matrices: torch.Tensor) -> int:
    return max([m.shape[0] for m in matrices if m.dim() == 3], default=1)  # len(m) takes as long as a small product


def _without_gaps(matrices: torch.Tensor) -> torch.Tensor:
    """Return matrices, or a copy if there are gaps between their rows, as in a part of a blob after a Slice."""
    return matrices if matrices.is_contiguous() or _are_stored_by_rows(matrices) else matrices.contiguous()


def _are_stored_by_rows(matrices: torch.Tensor) -> bool:
    rows, columns = matrices.shape[-2:]
    return (matrices.stride(-1) == 1 or columns == 1) and (matrices.stride(-2) == columns or rows == 1)


def _step(matrices: torch.Tensor) -> int:
    """Return the bytes from one matrix to the next; 0 for a single one."""
    return matrices.stride(0) * matrices.element_size() if matrices.dim() == 3 else 0


def dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the sum of the products of two tensors of equal counts, () (caffe_cpu_dot)."""
    return dots(a.reshape(1, -1, 1), b.reshape(1, -1, 1)).view(())


@one_thread()
def dots(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the sums (N, M) along axis 1 of the products of A and B, both (N, K, M) (caffe_cpu_strided_dot)."""
    count, length, stride = a.shape
    if stride == 1 and length < _IN_DOUBLE:
        return sum_in_order((a * b).double(), 1).to(a.dtype)
    a, b, call = a.contiguous(), b.contiguous(), _function("dot", a.dtype)
    numbers = ctypes.c_int(length), ctypes.c_int(stride)
    at_length, at_step = map(ctypes.addressof, numbers)
    first, second, size = a.data_ptr(), b.data_ptr(), a.element_size()
    starts = (size * (n * length * stride + m) for n in range(count) for m in range(stride))
    found = [call(at_length, first + start, at_step, second + start, at_step) for start in starts]
    return a.new_tensor(found).view(count, stride)


@one_thread()
def sum_of_magnitudes(values: torch.Tensor) -> torch.Tensor:
    """Return the sum of the absolute values, () (caffe_cpu_asum)."""
    values = values.contiguous()
    count, step = ctypes.c_int(values.numel()), ctypes.c_int(1)
    call = _function("asum", values.dtype)
    return values.new_tensor(call(ctypes.addressof(count), values.data_ptr(), ctypes.addressof(step)))


def sum_of_squares(values: torch.Tensor) -> torch.Tensor:
    """Return the sum of squares, () (caffe_cpu_dot of a blob with itself)."""
    flat = values.detach().flatten()
    return dot(flat, flat) if suits_blas(values) else torch.dot(flat, flat)


def sum_in_order(values: torch.Tensor, axis: int = 0) -> torch.Tensor:
    """Return the sums along an axis, each value added to the sum of those before it (a plain loop of Caffe's)."""
    sums = np.add.accumulate(array(values), axis).take(-1, axis)
    return torch.as_tensor(sums, dtype=values.dtype)


def kernels() -> set[str]:
    """Return OpenBLAS' names of the kernels that SciPy's BLAS has; an empty set if it is another BLAS."""
    return {pool.info().get("architecture", "unknown") for pool in _pools()}


def name() -> str:
    """Return the name of the BLAS that SciPy was built with, e.g. "scipy-openblas" or "accelerate" (macOS)."""
    config: Any = scipy.show_config(mode="dicts")
    return config["Build Dependencies"]["blas"]["name"]


@cache
def _pools() -> list[Any]:
    """Return the OpenBLAS of SciPy, or every loaded one if SciPy's is not in a folder of its own."""
    _library()  # loads its OpenBLAS
    if name() == "accelerate":
        return []
    pools = ThreadpoolController().select(internal_api="openblas").lib_controllers
    return [pool for pool in pools if "scipy.libs" in pool.filepath or "scipy/.dylibs" in pool.filepath] or pools
