"""Every layer case that BVLC Caffe computed: outputs, input gradients, parameter gradients, running statistics."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from fake_gpu import GPUS, gpu
from golden_cases import LayerCase, promised
from netspec.exact import CHOICES
from paths import GOLDEN

CASES = sorted((GOLDEN / "layers").iterdir())
TOLERANCE = 1e-5  # of the largest element
REAL_GPU = 1e-4  # likewise: its libraries choose among algorithms that round differently


@pytest.mark.parametrize("device", ["cpu", *(pytest.param(name, marks=pytest.mark.slow) for name in GPUS)])
@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_layer_computes_what_caffe_computed(
    folder: Path, device: str, record_property: Callable[[str, object], None]
) -> None:
    case = LayerCase(folder)
    with gpu(device) if device in GPUS else nullcontext("cpu") as name:
        for exact in CHOICES:
            found = case.compute(exact, name)
            outputs = [key for key in found if key.startswith("out/")]
            assert outputs == sorted(key for key in case.golden if key.startswith("out/")), exact
            worst = assert_close(found, case.golden, REAL_GPU if device == "cuda" else TOLERANCE, exact)
            record_property(f"off by, {exact}", worst)


def assert_close(
    found: Mapping[str, np.ndarray], golden: Mapping[str, np.ndarray], tolerance: float, exact: str
) -> float:
    """Return the largest difference, as a share of the array's largest element."""
    most = 0.0
    for key, value in found.items():
        expected = golden[key]
        assert value.shape == expected.shape, f"{exact}: {key}"
        scale = max(float(np.abs(expected).max(initial=0)), 1e-30)
        worst = float(np.abs(value.astype(np.float64) - expected).max(initial=0)) / scale
        assert worst <= tolerance, f"{exact}: {key}: off by {worst:.2e} of the largest element"
        most = max(most, worst)
    return most


@pytest.mark.slow
@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_a_run_without_gradients_computes_the_same(folder: Path) -> None:
    case = LayerCase(folder)
    for exact in CHOICES:
        assert_close(case.outputs(exact), case.golden, TOLERANCE, exact)


@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_layer_computes_caffes_bits(folder: Path, same_blas: bool) -> None:
    if not same_blas:
        pytest.skip("another kind of CPU than Caffe's: its BLAS rounds differently")
    case = LayerCase(folder)
    for exact in promised(folder):
        for key, value in [*case.compute(exact).items(), *case.outputs(exact).items()]:
            np.testing.assert_array_equal(value, case.golden[key], f"{exact}: {key}")
