"""Every layer case that BVLC Caffe computed: outputs, input gradients, parameter gradients, running statistics."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest

from fake_gpu import GPUS, gpu
from golden_cases import LayerCase, assert_arrays, promised
from netspec.exact import CHOICES
from paths import GOLDEN

CASES = sorted((GOLDEN / "layers").iterdir())
TOLERANCE = 1e-5  # of the largest element
REAL_GPU = 1e-4  # of the largest element too: GPU libraries choose among algorithms that round differently


@pytest.mark.parametrize("device", ["cpu", *(pytest.param(name, marks=pytest.mark.slow) for name in GPUS)])
@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_layer_equals_caffes_results(folder: Path, device: str, record_property: Callable[[str, object], None]) -> None:
    case = LayerCase(folder)
    with gpu(device) if device in GPUS else nullcontext("cpu") as name:
        for exact in CHOICES:
            found = case.compute(exact, name)
            outputs = [key for key in found if key.startswith("out/")]
            assert outputs == sorted(key for key in case.golden if key.startswith("out/")), exact
            worst = assert_arrays(found, case.golden, REAL_GPU if device == "cuda" else TOLERANCE, exact)
            record_property(f"off by, {exact}", worst)


@pytest.mark.slow
@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_layer_without_gradients_equals_caffes_results(folder: Path) -> None:
    case = LayerCase(folder)
    for exact in CHOICES:
        assert_arrays(case.outputs(exact), case.golden, TOLERANCE, exact)


@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_layer_equals_caffes_results_bit_for_bit(folder: Path, caffes_bits: bool) -> None:
    """On CPUs other than the one Caffe ran on, BLAS rounds differently, and the results are within the tolerance."""
    case = LayerCase(folder)
    for exact in promised(folder):
        for found in (case.compute(exact), case.outputs(exact)):
            assert_arrays(found, case.golden, 0 if caffes_bits else TOLERANCE, exact)
