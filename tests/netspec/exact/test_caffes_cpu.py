"""The tests that compare bits, on the kernels with which Caffe computed the golden files: those for AVX-512."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT

CPU = Path("/proc/cpuinfo")
COMPARING_BITS = [
    "exact/test_blas.py",
    "layers/test_golden.py",
    "pycaffe/test_golden.py",
    "solver/test_examples.py",
    "solver/test_golden.py",
]


@pytest.mark.slow
def test_bits_are_caffes_on_its_kind_of_cpu(same_blas: bool) -> None:
    """OpenBLAS chooses its kernels when it is loaded, so that another process is needed to choose others."""
    if same_blas:
        pytest.skip("the tests themselves run on these kernels")
    if not CPU.exists() or "avx512f" not in CPU.read_text():
        pytest.skip("this CPU has no AVX-512")
    tests = [str(ROOT / "tests" / "netspec" / name) for name in COMPARING_BITS]
    environment = os.environ | {"OPENBLAS_CORETYPE": "SkylakeX"}
    command = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", *tests]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:]
    assert "another kind of CPU" not in done.stdout, done.stdout[-4000:]
