"""BLAS uses its kernels for AVX-512, which computed the golden files, on CPUs that have them."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from netspec.exact import blas, machine
from netspec.exact.blas import CAFFES, CORE_TYPE
from netspec.net.net import Net
from paths import ROOT

OWN = "import scipy.linalg"  # OpenBLAS' own choice
CHOSEN = "from netspec.exact.blas import kernels; kernels()"
KERNELS = """
import os, threadpoolctl
{load}
found = [library for library in threadpoolctl.threadpool_info() if "scipy.libs" in library["filepath"]]
print(found[0]["architecture"])
print(os.environ.get("OPENBLAS_CORETYPE"))
"""
AFTERWARDS = (Path(__file__).parent / "programs" / "afterwards.py").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [None, "Haswell"])
def test_the_kernels_are_caffes_unless_the_user_chose_others(wanted: str | None) -> None:
    """OpenBLAS chooses its kernels when it is loaded, so that it takes another process to see which.

    Where the CPU has no AVX-512, the choice is OpenBLAS' own.
    """
    environment = {name: value for name, value in os.environ.items() if name != CORE_TYPE}
    environment |= {CORE_TYPE: wanted} if wanted else {}
    own, chosen = (
        subprocess.run(
            [sys.executable, "-c", KERNELS.format(load=load)],
            cwd=ROOT, env=environment, capture_output=True, text=True, check=True,
        ).stdout.split()
        for load in (OWN, CHOSEN)
    )  # fmt: skip
    for_caffe = not wanted and torch.backends.cpu.get_cpu_capability() == "AVX512"
    assert chosen == [CAFFES if for_caffe else own[0], str(wanted)]


@pytest.mark.slow
def test_scipy_linalg_is_complete_when_imported_afterwards() -> None:
    done = subprocess.run([sys.executable, "-c", AFTERWARDS], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["scipy.linalg.cython_blas", "scipy.linalg._fblas"]


@pytest.mark.parametrize(
    ("kernels", "exact", "said"),
    [
        ("Haswell", "all", ["Caffe's sums are computed by the kernels for Haswell, not SkylakeX (AVX-512)"]),
        (None, "all", ["Caffe's sums are computed by another BLAS (accelerate), not OpenBLAS"]),
        ("SkylakeX", "all", []),
        ("Haswell", "small", []),
    ],
)
def test_other_kernels_are_reported(
    kernels: str | None,
    exact: str,
    said: list[str],
    net_of: Callable[..., Net],
    warnings: Callable[[], list[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pools = [SimpleNamespace(info=lambda: {"architecture": kernels})] if kernels else []
    monkeypatch.setattr(blas, "_pools", lambda: pools)
    monkeypatch.setattr(blas, "name", lambda: "accelerate")
    monkeypatch.setattr(machine, "_functions", lambda: "")
    net_of('layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 } } }', exact=exact)
    assert [line.partition(":")[0] for line in warnings()] == said


def test_a_blas_other_than_openblas_has_no_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """SciPy for macOS adds with Accelerate, even if another library has loaded an OpenBLAS."""
    monkeypatch.setattr(blas, "name", lambda: "accelerate")
    blas._pools.cache_clear()
    try:
        assert blas.kernels() == set()
        assert "another BLAS (accelerate)" in machine.other_bits()
    finally:
        blas._pools.cache_clear()


def test_functions_that_are_rounded_otherwise_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    digests = {**machine._GLIBCS, "exp": "1", "pow": "2"}
    monkeypatch.setattr(machine, "digests", lambda: digests)
    monkeypatch.setattr(blas, "kernels", lambda: {CAFFES})
    assert machine.other_bits() == (
        "this C library rounds exp, pow otherwise than glibc 2.36, with which Caffe was compared"
    )
